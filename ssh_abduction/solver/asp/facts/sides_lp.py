"""Write facts for `fast/sides_framed.lp` and `fast/sides_frameless.lp`.

These encodings have rules about the order of places on a path and about its sides. They are added
to a search for dstates.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from ssh_abduction.data.trace import Action
from ssh_abduction.solver.steps.chart import FramedChart
from ssh_abduction.theory.theory import Theory


def sides_framed_facts(theory: Theory) -> str:
    """Return the facts that say which axioms about the sides of paths a theory has."""
    facts = ["sided."] if theory.boundary != "none" else []
    facts += ["symmetric."] if theory.symmetric_sides else []
    return "\n".join(facts)


def sides_frameless_facts(theory: Theory, actions: Mapping[int, Action]) -> str:
    """Return the facts for sides_frameless.lp: kinds of actions, and the axioms about sides."""
    kinds = [
        f"turns({a},{action.turn})." if action.turn else f"travels({a})."
        for a, action in actions.items()
        if action.kind in ("travel", "turn")
    ]
    return "\n".join([*kinds, sides_framed_facts(theory)])


def turn_facts(
    batch: int, chart: FramedChart, visits: Iterable[int], turns: Iterable[tuple[int, str, int]]
) -> str:
    """Return the facts about a batch: its new visits, and its turns (node, direction, node)."""
    facts = [f"visit({batch},{visit})." for visit in visits]
    for s, turn, x in turns:
        (visit, slot), (_, faced) = chart.facing[s], chart.facing[x]
        facts.append(f"{'about' if turn == 'around' else 'turns'}({batch},{visit},{slot},{faced}).")
    return "\n".join(facts)
