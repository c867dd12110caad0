"""The command line: one module a verb. Maps outcomes to exit codes.

0 done, a minimal map was proven | 1 a known error, one line on stderr | 2 wrong usage | 10 a map without proof | 20 no map satisfies
the axioms, or a checked map breaks one | 30 nothing in time | 130 interrupted | 143 ended by SIGTERM
"""

from __future__ import annotations

import argparse
import contextlib
import difflib
import errno
import io
import os
import sys
import warnings
from collections.abc import Iterable, Mapping, Sequence
from importlib.metadata import version
from typing import Any, NoReturn

from ssh_abduction.cli import (
    check,
    cluster,
    compare,
    completion,
    evaluate,
    examples,
    explain,
    export,
    facts,
    import_log,
    ladder,
    localize,
    map_logs,
    next_experiment,
    route,
    show,
    simulate,
    solve,
    theory,
    train,
    view,
)
from ssh_abduction.cli import reproduce as reproduction
from ssh_abduction.cli.guard import Guard
from ssh_abduction.cli.verbosity import add_verbosity, telling
from ssh_abduction.data import program
from ssh_abduction.data.errors import AbductionError, named, printable

EXIT_ERROR = 1
MENDS = {
    errno.ENOSPC: "make room",
    errno.ENOENT: "make the folder first",
    errno.EACCES: "take a place that you may write to",
    errno.EPERM: "take a place that you may write to",
    errno.EROFS: "take a place that you may write to",
    errno.EDQUOT: "make room",
    errno.ENAMETOOLONG: "take a shorter name",
    errno.EEXIST: "take another name",
    errno.EISDIR: "take another name",
    errno.ENOTDIR: "take another name",
}
FOR_PROGRAMS = (
    "json",
    "facts",
    "dot",
    "graphml",
    "svg",
)  # forms that other programs read, in UTF-8 wherever they are printed


class _Parser(argparse.ArgumentParser):
    """Takes part in a name that is nearly one of those expected: it says which was perhaps meant."""

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        try:
            super()._check_value(action, value)
        except argparse.ArgumentError as error:
            raise argparse.ArgumentError(
                action, f"{error.message}{_meant(value, map(str, action.choices or ()))}"
            ) from None

    def parse_args(self, args: Sequence[str] | None = None, namespace: Any = None) -> Any:  # type: ignore[override]
        """As argparse does, but what is unknown to a verb is an error of that verb, with the option that was perhaps meant."""
        options, unknown = self.parse_known_args(args, namespace)
        if unknown:
            verb = self.verbs[options.verb] if getattr(options, "verb", None) else self
            wrong = next((word for word in unknown if word.startswith("-")), unknown[0])
            verb.error(
                f"unrecognized arguments: {' '.join(unknown)}{_meant(wrong.partition('=')[0], verb.names)}"
            )
        return options

    @property
    def verbs(self) -> Mapping[str, _Parser]:
        """The parsers of the verbs."""
        return next(
            (
                action.choices
                for action in self._actions
                if isinstance(action, argparse._SubParsersAction)
            ),
            {},
        )

    @property
    def names(self) -> list[str]:
        """The names of all options."""
        return [name for action in self._actions for name in action.option_strings]

    def error(self, message: str) -> NoReturn:
        super().error(printable(message))  # which repeats what was typed


def _meant(word: object, names: Iterable[str]) -> str:
    """A question after the name that is nearest to a word, if one is near."""
    near = difflib.get_close_matches(str(word), names, n=1)
    return f"; did you mean {near[0]}?" if near else ""


def parser() -> argparse.ArgumentParser:
    """The parser of the whole command line."""
    top = _Parser(
        prog="ssh-abduction",
        description="From what a robot saw and did, find the map.",
        epilog="Exit codes: 0 minimal map proven; 1 error; 2 usage; 10 map without proof; 20 no map, or a map that breaks an axiom; "
        "30 nothing in time; 130 interrupted; 143 ended by SIGTERM.",
    )
    top.add_argument("--version", action="version", version=f"%(prog)s {version('ssh-abduction')}")
    verbs = top.add_subparsers(metavar="VERB", dest="verb", required=True)
    for verb in (
        solve,
        check,
        compare,
        explain,
        evaluate,
        ladder,
        localize,
        next_experiment,
        route,
        export,
        show,
        facts,
        theory,
        simulate,
        import_log,
        map_logs,
        cluster,
        train,
        view,
        reproduction,
        examples,
        completion,
    ):
        verb.add_parser(verbs)
    for each in (top, *verbs.choices.values()):
        add_verbosity(each)
    return top


def unwritten(error: OSError, output: object) -> str:
    """What is said of a file that cannot be written.

    Args:
        error: What the system says.
        output: What was to be written, for errors that name no file.
    """
    mend = MENDS.get(error.errno or 0, "check the path")
    return (
        f"{named(error.filename or output)}: cannot be written: {error.strerror or error}; {mend}"
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code. SystemExit, with code 2, for wrong usage."""
    try:
        code = _main(arguments)
    except KeyboardInterrupt:
        return program.interrupted_code()
    return (
        program.interrupted_code() if program.raised else code
    )  # a search may take Ctrl-C for its own end, and its verb goes on


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
    for_programs = (
        any(getattr(options, form, False) for form in FOR_PROGRAMS)
        or getattr(options, "output", None) == "-"
    )
    if isinstance(sys.stdout, io.TextIOWrapper) and for_programs:
        sys.stdout.reconfigure(
            encoding="utf-8", errors="backslashreplace"
        )  # what is left is half a character, which JSON writes so
    try:
        if sys.stdout is None:
            raise AbductionError(
                "standard output: expected a place to print to, got a closed stream; open it, or send it to a file"
            )
        with telling(options, for_programs), warnings.catch_warnings(record=True) as caught:
            try:
                with Guard(lambda: None, lambda _: ("", program.interrupted_code()), None, None):
                    code = int(options.run(options))
            finally:
                for warning in caught:
                    print(
                        f"ssh-abduction: warning: {printable(str(warning.message))}",
                        file=sys.stderr,
                    )
        sys.stdout.flush()
    except AbductionError as error:
        print(f"ssh-abduction: {error}", file=sys.stderr)
        return EXIT_ERROR
    except BrokenPipeError:
        # Whoever read the output has seen enough; what Python still holds back must not raise again at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except OSError as error:
        print(
            f"ssh-abduction: {unwritten(error, getattr(options, 'output', None) or 'standard output')}",
            file=sys.stderr,
        )
        with contextlib.suppress(OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return EXIT_ERROR
    return code
