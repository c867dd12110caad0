"""The real route of the ACES building, its maps, and the output of the shell, computed once for all
tests."""

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
    """Find the minimal maps of the route, at most `maps`, and those with up to `within` dstates
    more."""
    return solve(Trace.load(PATH), theory, max_maps=max_maps, within=within)


def route(steps: int) -> Trace:
    """The first steps of the route, which take a third of the time of all 23."""
    return Trace.load(PATH)[:steps]


@cache
def answer(*options: str, trace: str = ACES) -> str:
    """The output of `solve --json` for the route or another trace, with these options."""
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        assert main(["solve", trace, *options, "--json"]) == 0
    return printed.getvalue()
