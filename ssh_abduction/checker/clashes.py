"""Places whose stars (gateways seen) cannot fit one place (star=gateways).

A map does not show which gateway is which. So if no frame fits the stars of a place, a smallest
set of sights that no frame fits is reported, under each axiom whose removal would make one fit.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

from ssh_abduction.checker.reading import Check, Found, Reading
from ssh_abduction.data.gateways import Sight, Turns, by_place, fit, sights_of

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
    """A smallest set of sights that no frame of their place fits.

    Attributes:
        place: The place.
        steps: The steps of the sights.
        axioms: Each axiom that forbids the set: a frame fits once it is dropped.
    """

    place: int
    steps: tuple[int, ...]
    axioms: tuple[str, ...]


def clashes(sights: Sequence[Sight], turns: Turns, axioms: Collection[str]) -> Iterator[Clash]:
    """Find the places that no frame fits.

    Args:
        sights: The sights of a map, by first step.
        turns: The turns between sights at one place.
        axioms: Names of the axioms that hold.

    Yields:
        One clash for each such place.
    """
    hard = [name for name in NAMES if name in axioms]
    for place, seen in by_place(sights).items():
        if fit(seen, turns, hard) is not None:
            continue
        # drop sights, latest first, as long as no frame fits the others
        core = list(seen)
        for sight in reversed(seen):
            rest = [other for other in core if other is not sight]
            core = core if fit(rest, turns, hard) is not None else rest
        to_blame = [
            name
            for name in hard
            if fit(core, turns, [other for other in hard if other != name]) is not None
        ]
        yield Clash(place, tuple(sight.step for sight in core), tuple(to_blame or hard))


def _clashes_of(m: Reading) -> list[Clash]:
    return list(clashes(*sights_of(m.trace, m.map, m.onward), m.axioms))


def _gateways(name: str, m: Reading) -> Found:
    """The axioms of places with any number of gateways."""
    for clash in m.once(_clashes_of):
        if name not in clash.axioms:
            continue
        steps = ", ".join(map(str, clash.steps))
        if clash.axioms == ("gateway_end",):
            yield (
                clash.steps,
                f"The path goes on from place {clash.place}, but at steps {steps} no gateway is "
                "seen that leads on.",
            )
        else:
            yield (
                clash.steps,
                f"What is seen at steps {steps} cannot be one place, {clash.place}: the gateways "
                "do not agree, however turned.",
            )


AXIOMS: dict[str, Check] = {name: partial(_gateways, name) for name in NAMES}
