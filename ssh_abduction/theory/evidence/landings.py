"""Lifts as evidence: from one place, a lift leads to one place.

A robot may enter a lift with any heading, so at several dstates of a place. It always leaves it at
the same place of the other floor.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Trace
from ssh_abduction.theory.evidence.protocol import Equality, Evidence


@dataclass(frozen=True)
class Landings(Evidence):
    """Evidence from lifts that are taken again at the same place."""

    name: ClassVar[str] = "landings"
    axiom: ClassVar[str] = "one_landing"

    def refuse(self, trace: Trace, ssh_map: SSHMap, since: int = 0) -> frozenset[Equality] | None:
        places = [ssh_map.place_of(t) for t in range(len(ssh_map.dstate_at))]
        first: dict[tuple[int | None, str], int] = {}  # the first step after each lift
        for t in range(1, len(places)):
            action = trace.actions[t - 1]
            if not action.changes_floor or places[t - 1] is None:
                continue
            landing = first.setdefault((places[t - 1], action.name), t)
            if places[landing] != places[t]:
                return frozenset(
                    (
                        Equality(landing - 1, t - 1, "place"),
                        Equality(landing, t, "place", holds=False),
                    )
                )
        return None
