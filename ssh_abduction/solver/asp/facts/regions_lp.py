"""Write a map as facts for `derived/regions.lp`, and read the regions that it derives."""

from __future__ import annotations

from collections.abc import Collection

from clingo import Control, Symbol

from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.regions import Reason
from ssh_abduction.data.trace import Trace
from ssh_abduction.solver.asp.facts.atoms import COURSE

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
