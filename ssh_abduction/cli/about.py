"""ssh-abduction theory, facts and completion: the axioms, their input, and your shell."""

from __future__ import annotations

import argparse
import re
import sys

from ssh_abduction.cli.parsing import verb
from ssh_abduction.cli.shared import theory_of, theory_rows
from ssh_abduction.cli.text import table
from ssh_abduction.data.errors import AbductionError, printable
from ssh_abduction.data.trace import Trace
from ssh_abduction.solver import facts as encoding
from ssh_abduction.theory import encodings
from ssh_abduction.theory.settle import settle
from ssh_abduction.theory.theory import PRESETS


@verb()
def run_theory(options: argparse.Namespace) -> int:
    """List the axioms.

    Each axiom has a name, a sentence, a source, and the presets that include it.
    """
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


@verb(theory_rows=theory_rows())
def run_facts(options: argparse.Namespace) -> int:
    """Print a trace as .lp facts.

    Print a trace and a theory as facts for clingo, with the command that solves them with the
    encodings of this package.
    """
    text = encoding.program(settle(Trace.load(options.trace), theory_of(options)))
    if sys.stdout.isatty():  # escape control characters, which a terminal would obey
        text = "".join(f"{printable(line)}\n" for line in text.rstrip("\n").split("\n"))
    print(text, end="")
    return 0


@verb()
def run_completion(options: argparse.Namespace) -> int:
    """Print completions for a shell.

    Print the completion of verbs, options and files.

    bash: eval "$(ssh-abduction completion bash)" in ~/.bashrc; zsh: write it to a file
    _ssh-abduction in a folder of $fpath; fish: write it to
    ~/.config/fish/completions/ssh-abduction.fish
    """
    import shtab

    if options.shell not in shtab.SUPPORTED_SHELLS:
        raise AbductionError(
            f"completion: expected a shtab that knows {options.shell}, got {shtab.__version__}; "
            "pip install -U shtab"
        )
    from ssh_abduction.cli import parser

    top = parser()
    for one in (top, *top.verbs.values()):
        for action in one._actions:  # argparse has no public name for these
            if kind := _file_kind(action):
                action.complete = shtab.FILE if kind == "file" else shtab.DIRECTORY  # type: ignore[attr-defined]
    print(shtab.complete(top, options.shell))
    return 0


def _file_kind(action: argparse.Action) -> str | None:
    """Find out whether an argument names a "file", a "folder", or neither (None)."""
    if action.nargs == 0 or action.choices is not None:
        return None
    if not action.option_strings:
        return None if action.type in (int, float) else "file"
    named = str(action.metavar or "")
    if "FOLDER" in named:
        return "folder"
    return "file" if re.search(r"FILE|TRACE|MAPS|PNG|PAGE", named) else None
