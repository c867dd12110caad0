r"""Derive the regions of maps that were found. See encodings/derived/regions.lp for the axioms.

>>> from ssh_abduction import Trace, solve
>>> trace = Trace.from_steps("abcd", ["travel", "right", "travel"])
>>> (corner,) = solve(trace)
>>> print(*find_regions(corner, trace), sep="\n")
region 0: place 0, right of path 1+, behind place 1
region 1: place 2, right of path 0+, behind place 1
>>> corner.right_of(0, 1)
(2,)

Regions follow from a map and its trace. They cannot change which maps there are.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from typing import TypeAlias

from clingo import Control, Symbol

from ssh_abduction.data.map_parts import Reason, Region, of_members
from ssh_abduction.data.maps import SSHMap, check_of_trace, checked_map
from ssh_abduction.data.trace import Trace, checked_trace
from ssh_abduction.runtime.clock import look_at_clock
from ssh_abduction.solver.asp.control import new_control
from ssh_abduction.solver.asp.facts import COURSE
from ssh_abduction.theory import encodings
from ssh_abduction.theory.settle import settle
from ssh_abduction.theory.theory import Theory

# Deriving the regions of a map of n dstates takes about STARTING + n² units of 3.5 microseconds. A
# search spends at most UNITS on all its maps.
STARTING, UNITS = 1000, 130_000

_Key: TypeAlias = tuple[tuple[object, ...], ...]


def find_regions(ssh_map: SSHMap, trace: Trace, theory: Theory | None = None) -> tuple[Region, ...]:
    """Derive the regions of a map: places beside paths, and places behind one place.

    Args:
        ssh_map: A map of the trace.
        trace: The trace. It tells which actions are turns.
        theory: The theory of the map; Theory.topological() by default. Without its axioms about
            sides, no place is known to lie beside a path.

    Returns:
        The regions, the largest first; empty if the map has no places.

    Raises:
        MapError: The map is not of the trace.
        TraceError, TheoryError: The trace lacks something that the theory needs.

    Reference:
        Remolina & Kuipers 2004, "Towards a general theory of topological maps" (boundary regions).
    """
    checked_map(ssh_map)
    check_of_trace([ssh_map], checked_trace(trace), "map", views=False)
    theory = settle(trace, theory).theory
    return derived(ssh_map, trace, axioms_for_regions(theory))


def with_regions(ssh_map: SSHMap, trace: Trace, theory: Theory | None = None) -> SSHMap:
    """Return the same map with its field `regions`, as `find_regions` derives them."""
    return replace(ssh_map, regions=find_regions(ssh_map, trace, theory))


def axioms_for_regions(theory: Theory) -> frozenset[str]:
    """Return the names of the axioms that derive regions: those of the theory and of regions.lp."""
    return frozenset({*theory.axioms, *(axiom.name for axiom in encodings.region_axioms())})


def derived(ssh_map: SSHMap, trace: Trace, axioms: Collection[str]) -> tuple[Region, ...]:
    """Derive the regions of a map of a trace by some axioms, given by name."""
    if not ssh_map.places:
        return ()
    look_at_clock()
    return of_members(members_in(new_control("regions", region_facts(ssh_map, trace, axioms))))


class Deriving:
    """Adds regions to the maps of one search. Maps with the same dstates and links share them."""

    def __init__(self, trace: Trace, theory: Theory) -> None:
        self._trace = trace
        self._axioms = axioms_for_regions(theory)
        self._known: dict[_Key, tuple[Region, ...]] = {}
        self._left = UNITS

    def mapped(self, ssh_map: SSHMap) -> SSHMap:
        """Add the regions to a map, if it has places and few enough dstates for the time left."""
        key = (
            tuple((s.place, s.path, s.direction) for s in ssh_map.dstates),
            ssh_map.links,
            ssh_map.excused,
        )
        if key not in self._known:
            units = STARTING + len(ssh_map.dstates) ** 2
            if units > self._left or not ssh_map.places:
                return ssh_map
            self._left -= units
            self._known[key] = derived(ssh_map, self._trace, self._axioms)
        return replace(ssh_map, regions=self._known[key])


_DIRECTION = {1: "pos", -1: "neg"}


def region_facts(ssh_map: SSHMap, trace: Trace, axioms: Collection[str]) -> str:
    """Return the facts for regions.lp about a map with places, with the axioms that hold."""
    actions = {action.name: action for action in trace.actions}
    facts = [f"axiom({name})." for name in sorted(axioms)]
    for s in ssh_map.dstates:
        if s.place is not None:
            facts.append(f"at({s.id},{s.place}). floor({s.id},{s.floor or 0}).")
        if s.path is not None and s.direction is not None:
            facts.append(f"along({s.id},{s.path},{_DIRECTION[s.direction]}).")
    for source, name, target in ssh_map.links:
        action = actions.get(name)
        if action is not None and action.kind == "travel":
            facts.append(f"travelled({source},{target}).")
        elif action is not None and action.kind in ("lift", "stairs"):
            facts.append(f"lifted({source},{target}).")
        elif action is not None and action.turn in ("right", "left"):
            facts.append(f"turned({source},{action.turn},{target}).")
    facts += [f"excused({h},{g})." for h, g in ssh_map.excused]
    return "\n".join(facts)


def members_in(control: Control) -> dict[Reason, set[int]]:
    """Return a dict from the reason for a region to its places, from a control with regions.lp."""
    members: dict[Reason, set[int]] = {}
    reasons: dict[Symbol, Reason] = {}
    for atom in control.symbolic_atoms.by_signature("member", 2):
        assert atom.is_fact
        term, place = atom.symbol.arguments
        reason = reasons.setdefault(term, _reason(term, len(reasons)))
        members.setdefault(reason, set()).add(place.number)
    return members


def _reason(term: Symbol, number: int) -> Reason:
    """Return the reason for a region from its term. `number` tells terms apart."""
    first, *rest = term.arguments
    if term.name == "beside":
        return term.name, first.number, COURSE[rest[0].name]
    # Several regions may lie behind one place. The number tells them apart.
    return (term.name, first.number, number) if rest else (term.name, first.number)
