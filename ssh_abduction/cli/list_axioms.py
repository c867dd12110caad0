"""ssh-abduction theory: list the axioms, and the presets that include them."""

from __future__ import annotations

import argparse

from ssh_abduction.cli.parsing import Verbs
from ssh_abduction.cli.text import table
from ssh_abduction.theory import encodings
from ssh_abduction.theory.theory import PRESETS


def add_parser(verbs: Verbs) -> None:
    verbs.add(
        "theory",
        run,
        "list the axioms",
        "List every axiom with its name, sentence and source, and the presets that include it.",
    )


def run(options: argparse.Namespace) -> int:
    print(
        "A preset has an axiom: on = always; stars = if the trace has stars that fit right angles; "
        "gateways = if it has other stars; – = never"
    )
    for level in encodings.levels():
        print(f"\n{level}")
        rows = [
            [a.name, *(_state(a.name, preset) for preset in PRESETS), a.sentence, f"[{a.source}]"]
            for a in encodings.axioms()
            if a.level == level
        ]
        print(table(["axiom", *PRESETS, "sentence", "source"], rows))
    print("\nregions (derived from a map after the search)")
    rows = [[a.name, a.sentence, f"[{a.source}]"] for a in encodings.region_axioms()]
    print(table(["axiom", "sentence", "source"], rows))
    print(f"\nThe encodings are in {encodings.folder()}")
    return 0


def _state(name: str, preset: str) -> str:
    """Say if a preset has an axiom: "on", only with "stars" or "gateways", or "–" if never."""
    theory = PRESETS[preset]()
    if name in theory.axioms:
        return "on"
    settled = {"stars": "frame", "gateways": "gateways"} if theory.star == "auto" else {}
    return next(
        (said for said, star in settled.items() if name in theory.replace(star=star).axioms), "–"
    )
