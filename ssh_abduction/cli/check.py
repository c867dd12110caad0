"""ssh-abduction check TRACE MAPS: do these maps satisfy the axioms?"""

from __future__ import annotations

import argparse

from ssh_abduction.checker import check
from ssh_abduction.cli.options import Verbs, add_theory, theory_of
from ssh_abduction.maps import maps_of, read_json
from ssh_abduction.theory import Theory
from ssh_abduction.trace import Trace

EXIT_VIOLATED = 20


def add_parser(verbs: Verbs) -> None:
    text = "Check maps against a trace and the axioms, without clingo. Which named axiom fails, and at which steps?"
    parser = verbs.add_parser("check", help="do these maps satisfy the axioms?", description=text)
    parser.add_argument("trace", help="trace file (JSON Lines), or - for standard input")
    parser.add_argument("maps", help="what solve --json printed, or one saved map")
    add_theory(parser)
    parser.set_defaults(run=run, theory=None)
    parser.epilog = "Without --theory, the theory is the one that the file of maps was solved under; other flags are laid over it."


def run(options: argparse.Namespace) -> int:
    trace = Trace.load(options.trace)
    data = read_json(options.maps)
    found = data.get("theory") if isinstance(data, dict) else None
    theory = theory_of(options, None if found is None else Theory.from_dict(found))
    maps = maps_of(data, str(options.maps))
    broken = 0
    for i, ssh_map in enumerate(maps):
        violations = check(trace, ssh_map, theory)
        broken += bool(violations)
        for v in violations:
            steps = f"{'step' if len(v.steps) == 1 else 'steps'} {', '.join(map(str, v.steps))}: " if v.steps else ""
            print(f"map {i + 1}: {v.axiom}: {steps}{v.message}")
    print(f"{len(maps) - broken} of {len(maps)} maps satisfy the {len(theory.resolve(trace).axioms)} axioms")
    return EXIT_VIOLATED if broken else 0
