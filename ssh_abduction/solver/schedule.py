"""The schedule of a search: its sources in order, each with its share of the work and the reason.

A source puts maps or proven lower bounds on the board. `search.py` runs the sources in the order of
this table, until a map costs no more than the bound, or no work is left. No other module says how
much of the work a source gets. A unit of work is about a second of a quiet core; without a work
limit, seconds count instead.

The page docs/reference/schedule.md shows this table (`python website/schedule_table.py` writes it).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from ssh_abduction.runtime.limits import RESERVE, Watch


@dataclass(frozen=True, slots=True)
class SourceTurn:
    """The turn of a source.

    Attributes:
        name: The name of the source.
        problems: For which problems the source runs.
        why: Why it gets this share.
        share: The source ends when this share of the work left at its begin is done.
        until: The source ends when this share of the whole limit is used up.
        most: The source ends after this many units of work in any case.
    """

    name: str
    problems: str
    why: str
    share: float = 1.0
    until: float = 1.0
    most: float = math.inf

    def work(self, watch: Watch) -> float:
        """Return how much work the source may do if it begins now."""
        left, until = watch.left(), math.inf
        if self.until < 1 and left < math.inf:
            until = max(self.until * (watch.elapsed() + left) - watch.elapsed(), 0.0)
        return min(self.share * left, self.most, until)

    def ends(self, watch: Watch) -> float:
        """Return what the clock shows when the source has to end."""
        return watch.elapsed() + self.work(watch)


COUNTED = (
    SourceTurn(
        "greedy merging",
        "causal theories, more than 24 steps",
        "It takes milliseconds, and clingo then only has to find a better map.",
    ),
    SourceTurn(
        "mending",
        "theories with faults, more than 24 steps",
        "It finds the fewest faults by solving traces without them.",
    ),
    SourceTurn(
        "maps without own rules",
        "theories with rules of the user, no faults",
        "Such rules only exclude maps, and no fast method knows them.",
        share=0.5,
    ),
    SourceTurn(
        "prefixes",
        "theories without frames, more than 24 steps",
        "A trace that is not solved by then is seldom solved step by step.",
        share=0.4,
        most=1.0,
    ),
    SourceTurn(
        "maps with frames",
        "the same, with the speed-up `framing`",
        "They are only candidates. Without any map they may take twice as long.",
        share=0.4,
        most=30.0,
    ),
    SourceTurn(
        "exact search",
        "all",
        "It proves the minimum and lists all maps: prefixes, dstates first, or names.",
    ),
)
WEIGHED = (
    SourceTurn("sketch", "all", "There must be a map before any long source begins.", share=0.4),
    SourceTurn(
        "smoothing",
        "displacements, no lifts, no faults within a drive but misread views without stars",
        "After a long way, poses that fit all closures are better than a beam.",
        until=0.5,
    ),
    SourceTurn(
        "false closures",
        "traces with closures; logs of robots only if their map does not fit",
        "If closures are false, beams have to know which ones.",
        share=0.3,
    ),
    SourceTurn(
        "joint drives",
        "several drives, no lifts, no faults within a drive but misread views without stars",
        "It takes a fifth of the work of a beam over all drives, which found no cheaper map.",
        until=0.6,
    ),
    SourceTurn(
        "other joint maps",
        "the same",
        "What fits best for one drive or two may be false, and only the other drives tell.",
        share=0.5,
    ),
    SourceTurn(
        "beam of 1",
        "up to 2,000 steps, unless joining drives gave one piece",
        "It finds most true maps.",
        until=0.7,
    ),
    SourceTurn(
        "beam of 4",
        "the same",
        "A map that a broad beam ends with is nearly always the best one.",
        until=0.6,
    ),
    SourceTurn(
        "beam of 16",
        "one drive on one floor",
        "With several drives or floors, a beam of 4 keeps as many hypotheses.",
        until=0.7,
    ),
    SourceTurn(
        "beams of logs",
        "logs of robots: all beams",
        "Smoothing has mostly found the best map there, and bounds need the work.",
        until=0.5,
    ),
    SourceTurn(
        "beams with wrong displacements",
        "theories with `jumped`: all beams",
        "They often drop the best map. The search for wrong displacements finds it.",
        until=0.2,
    ),
    SourceTurn(
        "beam without axioms",
        "a broad beam ended",
        "It says how much cheaper a map that breaks axioms would be.",
        until=0.8,
    ),
    SourceTurn(
        "moved visits",
        "topological theories, no wrong displacements",
        "A visit near two places may be joined to the wrong one, and merging does not move it.",
        share=0.3,
    ),
    SourceTurn(
        "wrong displacements",
        "theories with `jumped`, more than 60 steps",
        "A search over which displacements are wrong. No source proves such maps.",
        until=0.9,
    ),
    SourceTurn(
        "fewest dstates, map known",
        "a map is known, and no faults are allowed",
        "It only finds the least number of dstates, if that is easy.",
        share=0.05,
    ),
    SourceTurn(
        "fewest dstates",
        "no map is known, or faults are allowed",
        "A map with the fewest dstates is the only one then.",
        share=0.4,
    ),
    SourceTurn(
        "forced joins",
        "no faults but misread views, up to 2,500 steps",
        "Branch and bound over joins raises the bound most. If it ends, this is a proof.",
        share=0.9,
        most=30.0,
    ),
    SourceTurn(
        "forced joins, last",
        "the same, for long traces with faults",
        "No other source can prove that these maps are the best.",
        most=30.0,
    ),
    SourceTurn(
        "Benders cuts",
        "all but long traces with faults",
        "Clingo lists maps by counts, and each misfit excludes many. This is the proof.",
    ),
)
LATE = (
    SourceTurn(
        "estimated rivals",
        "maps are weighed by cost",
        "The confidence counts rivals that no source found.",
        most=0.5,
    ),
    SourceTurn(
        "backbone",
        "not all minimal maps are listed",
        "What all minimal maps share needs a search of its own.",
        share=0.2,
    ),
    SourceTurn(
        "reserve",
        "no map is known",
        "The last part of the limit is for a sketch, so that there always is a map.",
        share=RESERVE,
    ),
)
TABLE = {"If maps are counted": COUNTED, "If maps are weighed by cost": WEIGHED, "In the end": LATE}
TURNS = {turn.name: turn for part in TABLE.values() for turn in part}


def turn(name: str) -> SourceTurn:
    """Return the turn of a source, by its name."""
    return TURNS[name]


class Source(NamedTuple):
    """A source as a search runs it: its turn, whether it suits the problem now, and its work."""

    turn: SourceTurn
    suits: Callable[[], bool]
    run: Callable[[], None]
