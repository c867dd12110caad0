"""The command line, with a module for each verb or a few related verbs.

Exit codes:
    0: Success.
    1: A known error, with one line on stderr.
    2: Wrong usage.
    10: With --strict, a map or plan that is not proven best.
    20: No map satisfies the axioms, or a checked map breaks an axiom.
    30: No map was found in time.
    130: Interrupted by Ctrl-C.
    143: Ended by SIGTERM.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import os
import re
import sys
import warnings
from collections.abc import Mapping, Sequence
from functools import cache
from importlib.metadata import version
from typing import Any

from ssh_abduction.cli import (
    about,
    compare,
    correct,
    import_log,
    judge,
    learn,
    live_map,
    mapping,
    mcp,
    repair,
    simulate,
    solve,
    use,
)
from ssh_abduction.cli.outcome import (
    EXIT_ERROR,
    EXIT_UNPROVEN,
    Guard,
    add_verbosity,
    telling,
    unwritten,
    warn,
)
from ssh_abduction.cli.parsing import Parser, Verb, rows_of
from ssh_abduction.cli.shared import check_inputs_are_kept
from ssh_abduction.data.errors import AbductionError, printable
from ssh_abduction.data.files import json_line
from ssh_abduction.runtime import program

# The verbs, grouped by purpose as the help lists them.
VERBS: Mapping[str, tuple[Verb, ...]] = {
    "map: find the maps of a trace or a log": (
        solve.run_solve,
        mapping.run_map,
        live_map.run_live,
        import_log.run_import,
        learn.run_cluster,
    ),
    "ask: judge, compare and explain maps": (
        judge.run_check,
        compare.run_compare,
        judge.run_explain,
        compare.run_evaluate,
        compare.run_next,
        repair.run_repair,
    ),
    "use: drive and localise by a map": (
        use.run_localise,
        use.run_route,
        use.run_show,
        use.run_export,
        use.run_view,
        correct.run_name,
        correct.run_correct,
        mcp.run_mcp,
    ),
    "learn: recognise places from images": (learn.run_train, learn.run_recognise),
    "make: simulated robots and the paper's experiments": (
        simulate.run_simulate,
        simulate.run_examples,
        simulate.run_demo,
    ),
    "about: the axioms, their input, and your shell": (
        about.run_theory,
        about.run_facts,
        about.run_completion,
    ),
}
SEE_WORDS = "Words such as dstate are explained by: ssh-abduction --help"


@cache
def parser() -> Parser:
    """Make the parser of the whole command line. It is cached, as it has hundreds of options."""
    top = Parser(
        prog="ssh-abduction",
        description="Find the topological maps that explain what a robot saw and did.",
        epilog="\n\n".join(f"{form[2:]}: {said}" for form, said in rows_of("program").items()),
    )
    top.add_argument("--version", action="version", version=f"%(prog)s {version('ssh-abduction')}")
    said = "one of the verbs below; ssh-abduction VERB --help describes it"
    verbs = top.add_subparsers(metavar="VERB", dest="verb", required=True, help=said)
    for title, members in VERBS.items():
        for verb in members:
            added = verbs.add_parser(
                verb.name, help=verb.summary, description=verb.help, epilog=SEE_WORDS
            )
            added.set_defaults(act=verb.run)
            added.add_rows(verb.rows)
            add_verbosity(added)
        listed = top.add_argument_group(title)
        listed._group_actions += verbs._choices_actions[-len(members) :]
    add_verbosity(top)
    return top


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit code.

    Args:
        arguments: The words after the program's name; None for those in `sys.argv`.

    Raises:
        SystemExit: The usage is wrong (code 2), or help was asked for (code 0).
    """
    try:
        code = _main(arguments)
    except KeyboardInterrupt:
        return program.interrupted_code()
    # A search may end at Ctrl-C while its verb goes on and returns a code.
    return program.interrupted_code() if program.raised else code


def _parsed(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Parse the options. Reject a value "--", which argparse reads as an empty list or as text."""
    top = parser()
    for word in sys.argv[1:] if arguments is None else arguments:
        if found := re.fullmatch(r"(-\w|--[\w-]+)=?((?<==)\w+=)?--", word):
            flag = found[1]
            top.error(f"{flag}: expected a value, got '--'; give one, or leave the option out")
    options: argparse.Namespace = top.parse_args(arguments)
    return options


def _main(arguments: Sequence[str] | None) -> int:
    if sys.stderr is None:
        sys.stderr = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115 - never closed
    options = _parsed(arguments)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # a terminal without "→" shows "?"
    # Other programs read this output, so it is always UTF-8.
    for_programs = (
        options.verb == "facts"
        or getattr(options, "json", False)
        or getattr(options, "output", None) == "-"
    )
    if isinstance(sys.stdout, io.TextIOWrapper) and for_programs:
        # Only surrogates cannot be encoded. JSON writes them as escapes.
        sys.stdout.reconfigure(encoding="utf-8", errors="backslashreplace")
    output = _Output(sys.stdout)
    try:
        if sys.stdout is None:
            raise AbductionError(
                "standard output: expected a place to print to, got a closed stream; open it, or "
                "send it to a file"
            )
        with telling(options, for_programs), warnings.catch_warnings(record=True) as caught:
            try:
                check_inputs_are_kept(options)
                guard = Guard(lambda: None)
                with contextlib.redirect_stdout(output), guard:
                    program.shown[EXIT_UNPROVEN] = EXIT_UNPROVEN * getattr(options, "strict", False)
                    code = int(options.act(options))
                    code = program.shown.get(code, code)
            finally:
                warn(dict.fromkeys(printable(str(warning.message)) for warning in caught))
        sys.stdout.flush()
    except AbductionError as error:
        return _failed(options, str(error), output)
    except BrokenPipeError:
        # The reader has closed the pipe. Text in Python's buffer must not raise again at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except OSError as error:
        file = getattr(options, "output", None) or "standard output"
        _failed(options, unwritten(error, file), output)
        with contextlib.suppress(OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return EXIT_ERROR
    return code


class _Output:
    """Standard output, which also knows whether anything was printed: `is_used`."""

    def __init__(self, stream: Any) -> None:
        self._stream, self.is_used = stream, False

    def write(self, text: str) -> int:
        self.is_used = True
        return int(self._stream.write(text))

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def _failed(options: argparse.Namespace, message: str, output: _Output) -> int:
    """Print an error on stderr. With --json, print it as JSON if stdout is empty."""
    print(f"ssh-abduction: {message}", file=sys.stderr)
    if getattr(options, "json", False) and not output.is_used:
        with contextlib.suppress(OSError, ValueError):
            print(json_line({"status": "error", "error": message}), flush=True)
    return EXIT_ERROR
