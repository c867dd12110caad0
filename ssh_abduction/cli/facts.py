"""ssh-abduction facts TRACE: print the trace as facts for clingo."""

from __future__ import annotations

import argparse
import sys

from ssh_abduction.cli.options import add_theory, theory_of, trace_path
from ssh_abduction.cli.parsing import Verbs
from ssh_abduction.data.errors import printable
from ssh_abduction.data.trace import Trace
from ssh_abduction.solver import facts as encoding
from ssh_abduction.theory.settle import settle


def add_parser(verbs: Verbs) -> None:
    parser = verbs.add(
        "facts",
        run,
        "print a trace as .lp facts",
        "Print a trace and a theory as facts for clingo, with the command that solves them with "
        "the encodings of this package.",
    )
    parser.add("trace", "trace file (JSON Lines), or - for standard input", type=trace_path)
    add_theory(parser)
    parser.set_defaults(facts=True)


def run(options: argparse.Namespace) -> int:
    text = encoding.program(settle(Trace.load(options.trace), theory_of(options)))
    if sys.stdout.isatty():  # escape control characters, which a terminal would obey
        text = "".join(f"{printable(line)}\n" for line in text.rstrip("\n").split("\n"))
    print(text, end="")
    return 0
