"""Check the axioms about places with any number of gateways (star=gateways).

A star is the set of gateways seen at a step. A sight is a dstate and a star seen there. A frame is
a numbering of the gateways of a place. A map does not list which gateways of two sights are the
same. So if no frame fits all sights of a place, the check reports a minimal set of sights that no
frame fits. If a frame would fit this set without an axiom, the set violates this axiom.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

from ssh_abduction.checker.reading import Found, Reading
from ssh_abduction.data.drives import drives_of
from ssh_abduction.data.gateways import (
    Sight,
    Turns,
    by_place,
    changes_of,
    frames_that_fit,
    sights_of,
)

NAMES = (
    "gateway_frame",
    "gateway_heading",
    "gateway_turn",
    "gateway_dstate",
    "gateway_path",
    "gateway_end",
)


@dataclass(frozen=True)
class Clash:
    """A minimal set of sights (dstate and star) of a place that no frame of the place fits.

    Attributes:
        place: The place.
        steps: The first step of each sight.
        axioms: The axioms that forbid the set. Leaving out any one of them lets a frame fit. If
            there is no such axiom, these are all axioms of the theory about gateways.
    """

    place: int
    steps: tuple[int, ...]
    axioms: tuple[str, ...]


def clashes(sights: Sequence[Sight], turns: Turns, axioms: Collection[str]) -> Iterator[Clash]:
    """Yield a minimal set of sights (dstate and star) for each place where they fit no frame.

    The sights are those of a map, sorted by first step. `turns` has the turns between sights of one
    place. `axioms` has the names of the theory's axioms.
    """
    hard = [name for name in NAMES if name in axioms]
    for place, seen in by_place(sights).items():
        if frames_that_fit(seen, turns, hard) is not None:
            continue
        # drop sights, latest first, as long as no frame fits the others
        core = list(seen)
        for sight in reversed(seen):
            rest = [other for other in core if other is not sight]
            core = core if frames_that_fit(rest, turns, hard) is not None else rest
        to_blame = [
            name
            for name in hard
            if frames_that_fit(core, turns, [other for other in hard if other != name]) is not None
        ]
        yield Clash(place, tuple(sight.step for sight in core), tuple(to_blame or hard))


def _clashes_of(m: Reading) -> list[Clash]:
    """List the clashes of a map: sights of a place that fit no frame."""
    return list(clashes(*_sights_of(m), m.axioms))


def _sights_of(m: Reading) -> tuple[list[Sight], Turns]:
    """Return the sights of a map, for each drive if gateways may change; and the turns."""
    return sights_of(m.trace, m.map, m.onward, bool(m.theory.changed))


def bearing_changes(m: Reading) -> Iterator[tuple[int, int, int, str, str]]:
    """Yield the gateways that differ between a drive and the drive before it at the same place.

    Each has the place, the bearing, the first step of the later drive there, and what the earlier
    and the later drive saw, in words.
    """
    names = [drive.name for drive in drives_of(m.trace)]
    for found in changes_of(*_sights_of(m), m.axioms):
        was, now = (names[drive] for drive in found.drives)
        is_open, was_open = (("closed", "open"), ("open", "closed"))[found.is_open]
        seen = f"{was_open} on {was}", f"{is_open} on {now}"
        yield found.place, found.bearing, found.step, *seen


def _gateways(name: str, m: Reading) -> Found:
    """Check the axiom `name` about places with any number of gateways."""
    for clash in m.once(_clashes_of):
        if name not in clash.axioms:
            continue
        steps = ", ".join(str(m.steps[t]) for t in clash.steps)
        if clash.axioms == ("gateway_end",):
            yield (
                clash.steps,
                f"The path goes on from place {clash.place}, but at steps {steps} no gateway is "
                "seen that leads on.",
            )
        else:
            yield (
                clash.steps,
                f"Steps {steps} cannot all be at place {clash.place}: in no rotation do the "
                "gateways seen there agree.",
            )


gateway_frame = partial(_gateways, "gateway_frame")
gateway_heading = partial(_gateways, "gateway_heading")
gateway_turn = partial(_gateways, "gateway_turn")
gateway_dstate = partial(_gateways, "gateway_dstate")
gateway_path = partial(_gateways, "gateway_path")
gateway_end = partial(_gateways, "gateway_end")
