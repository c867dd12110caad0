"""A drive through a hallway, simulated once, and a laser that sees less: tests of drives take less
time."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from functools import cache

from perception.readers.scans import Scan
from simulator.tours import record
from simulator.world import World
from ssh_abduction.cli.simulate import scans_of


@cache
def hall(every: float = 1.0) -> tuple[Scan, ...]:
    """A tour through the hallway of Taylor Hall, with a scan each metre, or after other distances.

    The first 80 scans lead into a side hallway and out of it.
    """
    return tuple(scans_of(record(World.named("taylor-hall"), every=every)))


def every_second_beam(scans: Iterable[Scan]) -> tuple[Scan, ...]:
    """The scans of a laser with half as many beams."""
    return tuple(
        replace(
            scan,
            ranges=scan.ranges[::2],
            laser=replace(scan.laser, beams=len(scan.ranges[::2]), step=2 * scan.laser.step),
        )
        for scan in scans
    )
