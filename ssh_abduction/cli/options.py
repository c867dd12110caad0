"""Options that several verbs share: the choice of a theory."""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import fields
from pathlib import Path
from typing import Any

from ssh_abduction.data.errors import AbductionError, MapError, named
from ssh_abduction.data.map_file import read_json
from ssh_abduction.data.trace import Trace
from ssh_abduction.theory.theory import (
    ASSERTIONS,
    CHOICES,
    COUNTS,
    EXCUSED,
    PRESETS,
    SETTLED,
    Theory,
)

Verbs = Any  # argparse's type for what add_subparsers returns is private


def add_theory(
    parser: argparse.ArgumentParser, default: str = "topological, or causal with --level causal"
) -> None:
    """Add --theory PRESET, and a flag for each field of Theory to lay over it."""
    group = parser.add_argument_group("theory", "a preset, and choices laid over it")
    group.add_argument("--theory", choices=PRESETS, help=f"preset (default: {default})")
    for name, values in CHOICES.items():
        group.add_argument(f"--{name.replace('_', '-')}", choices=values)
    said = dict(re.findall(r"^ +(\w+)  +(.+)$", Theory.__doc__ or "", re.MULTILINE))
    for field in fields(Theory):
        if isinstance(field.default, bool) and field.name not in SETTLED:
            group.add_argument(
                f"--{field.name.replace('_', '-')}",
                action=argparse.BooleanOptionalAction,
                help=said.get(field.name),
            )
    group.add_argument("--reject", type=float, metavar="P", help=said.get("reject"))
    group.add_argument("--joint", type=int, metavar="N", help=said.get("joint"))
    for name in EXCUSED:
        group.add_argument(f"--{name}", type=float, metavar="DSTATES", help=said.get(name))
    group.add_argument(
        "--prefer",
        metavar="COUNTS",
        help=f"what to minimise, first to last, of {', '.join(COUNTS)}; commas between",
    )
    group.add_argument("--without", metavar="AXIOMS", help="leave these axioms out; commas between")
    group.add_argument(
        "--rules",
        action="append",
        metavar="FILE",
        help="rules of your own, over the predicates of the encodings; may be given again",
    )
    for name, text in (
        ("same", "are one dstate"),
        ("different", "are different dstates"),
        ("elsewhere", "are at different places"),
    ):
        group.add_argument(
            f"--{name}",
            action="append",
            metavar="I,J",
            help=f"steps I and J {text}; may be given again",
        )


def add_output(parser: argparse.ArgumentParser) -> None:
    """Add -o TRACE."""
    parser.add_argument(
        "-o",
        "--output",
        type=output,
        required=True,
        metavar="TRACE",
        help="trace file to write, or - for standard output",
    )


def write(trace: Trace, target: str, said: str) -> None:
    """Write a trace where add_output says, and what is said of it: beside it, where the trace goes to standard output."""
    if target == "-":
        sys.stdout.writelines(line + "\n" for line in trace.to_lines())
        print(said, file=sys.stderr)
    else:
        trace.save(target)
        print(f"{said} in {named(target)}")


def output(text: str) -> str:
    """A file or folder to write."""
    if not text or "\0" in text:
        raise argparse.ArgumentTypeError(
            f"expected the name of a file or folder, got {text!r}; name one"
        )
    return text


def seed(text: str) -> int:
    """A seed of random numbers."""
    if not text.isdecimal() or int(text) >= 2**32:
        raise argparse.ArgumentTypeError(f"expected a number from 0 to {2**32 - 1}, got {text!r}")
    return int(text)


def picture_file(text: str) -> str:
    """A file that a figure can be drawn into."""
    if Path(text).suffix.lower() not in (".png", ".pdf", ".svg"):
        raise argparse.ArgumentTypeError(
            f"expected a name that ends in .png, .pdf or .svg, got {text!r}"
        )
    return text


def check_picture(file: str | None) -> None:
    """Whether a picture that is asked for could be drawn, before hours of work. Raises AbductionError."""
    if file is None:
        return
    from ssh_abduction.evaluation.paper.figures import require_matplotlib

    require_matplotlib()


def check_number(number: int | None, maps: Sequence[object], where: str) -> None:
    """Whether there is such a map, counted from 1. Raises MapError."""
    if number is not None and not 1 <= number <= len(maps):
        raise MapError(
            f"{where}: --map: expected 1 to {len(maps)}, got {number}"
            if maps
            else f"{where}: --map: expected a map, got none"
        )


def read_maps(file: str, mend: str = "name the maps first, and then the trace") -> Any:
    """The JSON in a file of maps. Raises MapError.

    mend  how it is mended if a trace is named instead; else as for a verb that takes the maps first
    """
    try:
        return read_json(file)
    except MapError:
        if file == "-" or not _is_trace(file):
            raise
        raise MapError(f"{named(file)}: expected a file of maps, got a trace; {mend}") from None


def _is_trace(file: str) -> bool:
    try:
        return bool(Trace.load(file))
    except AbductionError:
        return False


def theory_of(options: argparse.Namespace, found: Theory | None = None) -> Theory:
    """The theory that the options ask for: over the preset, or over the one found where no preset is named. Raises TheoryError."""
    chosen = choices_of(options)
    if options.theory is None and found is not None:
        return found.replace(**chosen)
    preset = "causal" if chosen.get("level") == "causal" else "topological"
    return PRESETS[options.theory or preset]().replace(**chosen)


def choices_of(options: argparse.Namespace) -> dict[str, Any]:
    """What the options say of single fields of a theory, by name, as it was given."""
    chosen = {
        f.name: getattr(options, f.name)
        for f in fields(Theory)
        if getattr(options, f.name, None) is not None
    }
    if "prefer" in chosen and not chosen["prefer"]:
        chosen["prefer"] = ()
    return chosen


def flags_of(theory: Theory, trace: Trace | None = None) -> list[str]:
    """The flags that make a command take this theory: the inverse of `theory_of`.

    trace  the trace that it is for: what the default theory settles for it needs no flag
    """
    default = Theory.causal() if theory.level == "causal" else Theory.topological()
    flags = ["--theory", "causal"] if theory.level == "causal" else []
    if trace is not None:
        with suppress(
            AbductionError
        ):  # the theory was made for a trace that has what the default asks for; this one may be another
            default = default.resolve(trace)
    for field in fields(Theory):
        value, flag = getattr(theory, field.name), f"--{field.name.replace('_', '-')}"
        if value == getattr(default, field.name) or field.name in ("level", *SETTLED):
            continue
        if isinstance(value, bool):
            flags.append(flag if value else f"--no-{flag[2:]}")
        elif field.name == "rules":
            flags += [part for rules in value for part in (flag, rules.name)]
        elif field.name in ASSERTIONS:
            flags += [part for i, j in value for part in (flag, f"{i},{j}")]
        elif isinstance(value, tuple):
            flags += [flag, ",".join(value)]
        else:
            flags += [flag, f"{value:g}" if isinstance(value, float) else str(value)]
    return flags
