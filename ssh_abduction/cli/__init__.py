"""The command line: one module a verb. Maps outcomes to exit codes.

0 done, a minimal map was proven | 1 a known error, one line on stderr | 2 wrong usage | 10 a map without proof | 20 no map satisfies
the axioms, or a checked map breaks one | 30 nothing in time | 130 interrupted | 143 ended by SIGTERM
"""

from __future__ import annotations

import argparse
import contextlib
import errno
import io
import os
import sys
import warnings
from collections.abc import Sequence
from importlib.metadata import version
from typing import NoReturn

from ssh_abduction.cli import check, cluster, compare, evaluate, facts, ladder, localize, show, simulate, solve, theory, train
from ssh_abduction.cli import reproduce as reproduction
from ssh_abduction.errors import SSHError, named, printable

EXIT_ERROR, EXIT_INTERRUPTED = 1, 130
MENDS = {
    errno.ENOSPC: "make room",
    errno.ENOENT: "make the folder first",
    errno.EACCES: "take a place that you may write to",
    errno.EEXIST: "take another name",
    errno.EISDIR: "take another name",
    errno.ENOTDIR: "take another name",
}
FOR_PROGRAMS = ("json", "facts", "dot", "graphml", "svg")  # forms that other programs read, in UTF-8 wherever they are printed


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        super().error(printable(message))  # which repeats what was typed


def parser() -> argparse.ArgumentParser:
    """The parser of the whole command line."""
    top = _Parser(
        prog="ssh-abduction",
        description="From what a robot saw and did, find the map.",
        epilog="Exit codes: 0 minimal map proven; 1 error; 2 usage; 10 map without proof; 20 no map, or a map that breaks an axiom; "
        "30 nothing in time; 130 interrupted; 143 ended by SIGTERM.",
    )
    top.add_argument("--version", action="version", version=f"%(prog)s {version('ssh-abduction')}")
    verbs = top.add_subparsers(metavar="VERB", required=True)
    for verb in (solve, check, compare, evaluate, ladder, localize, show, facts, theory, simulate, cluster, train, reproduction):
        verb.add_parser(verbs)
    return top


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code. SystemExit, with code 2, for wrong usage."""
    try:
        return _main(arguments)
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED


def _parsed(arguments: Sequence[str] | None) -> argparse.Namespace:
    """The options. argparse takes the -- of --map=-- for the end of all options, and the option is left with an empty list."""
    top = parser()
    options = top.parse_args(arguments)
    for name, value in vars(options).items():
        if isinstance(value, list) and (not value or [] in value):
            top.error(f"{name}: expected a value, got '--'")
    return options


def _main(arguments: Sequence[str] | None) -> int:
    if sys.stderr is None:
        sys.stderr = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115 - for as long as the program runs
    options = _parsed(arguments)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # a terminal that knows no "→" shows "?"
    for_programs = any(getattr(options, form, False) for form in FOR_PROGRAMS) or getattr(options, "output", None) == "-"
    if isinstance(sys.stdout, io.TextIOWrapper) and for_programs:
        sys.stdout.reconfigure(encoding="utf-8", errors="backslashreplace")  # what is left is half a character, which JSON writes so
    try:
        if sys.stdout is None:
            raise SSHError("standard output: expected a place to print to, got a closed stream; open it, or send it to a file")
        with warnings.catch_warnings(record=True) as caught:
            try:
                code = int(options.run(options))
            finally:
                for warning in caught:
                    print(f"ssh-abduction: warning: {printable(str(warning.message))}", file=sys.stderr)
        sys.stdout.flush()
    except SSHError as error:
        print(f"ssh-abduction: {error}", file=sys.stderr)
        return EXIT_ERROR
    except BrokenPipeError:
        # Whoever read the output has seen enough; what Python still holds back must not raise again at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except OSError as error:
        mend = MENDS.get(error.errno or 0, "check the path")
        print(f"ssh-abduction: {named(error.filename or 'output')}: cannot be written: {error.strerror or error}; {mend}", file=sys.stderr)
        with contextlib.suppress(OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return EXIT_ERROR
    return code
