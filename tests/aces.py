"""The real route of the ACES building, its maps, and what the command line says of it, which many
tests look at and none has to compute again."""

from __future__ import annotations

import contextlib
import io
from functools import cache
from pathlib import Path

from ssh_abduction import Solution, Theory, Trace, solve
from ssh_abduction.cli import main

PATH = Path(__file__).parent.parent / "examples" / "aces3-route.jsonl"
ACES = str(PATH)


@cache
def solution(
    theory: Theory | None = None, max_maps: int | None = None, within: int = 0
) -> Solution:
    """The minimal maps of it, all or so many, and those of up to so many dstates more."""
    return solve(Trace.load(PATH), theory, max_maps=max_maps, within=within)


@cache
def answer() -> str:
    """What `solve --json` prints of it."""
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        assert main(["solve", ACES, "--json"]) == 0
    return printed.getvalue()
