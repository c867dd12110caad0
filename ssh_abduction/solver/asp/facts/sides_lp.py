"""Facts for `fast/sides_*.lp`, the axioms that the sides of paths impose."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from ssh_abduction.data.trace import Action
from ssh_abduction.solver.steps.chart import FramedChart
from ssh_abduction.theory.theory import Theory


def sides_framed_facts(theory: Theory) -> str:
    """Which axioms of the sides of paths hold in a theory, as facts."""
    facts = ["sided."] if theory.boundary != "none" else []
    facts += ["symmetric."] if theory.symmetric_sides else []
    return "\n".join(facts)


def sides_frameless_facts(theory: Theory, actions: Mapping[int, Action]) -> str:
    """Kinds of actions, and the axioms of sides, as facts for sides_frameless.lp."""
    kinds = [
        f"turns({a},{action.turn})." if action.turn else f"travels({a})."
        for a, action in actions.items()
        if action.kind
    ]
    return "\n".join([*kinds, sides_framed_facts(theory)])


def turn_facts(
    batch: int, chart: FramedChart, visits: Iterable[int], turns: Iterable[tuple[int, str, int]]
) -> str:
    """New visits, and new turns on a visit, from slot to slot, as facts for sides_framed.lp."""
    facts = [f"visit({batch},{visit})." for visit in visits]
    for s, turn, x in turns:
        (visit, slot), (_, faced) = chart.facing[s], chart.facing[x]
        facts.append(f"{'about' if turn == 'around' else 'turns'}({batch},{visit},{slot},{faced}).")
    return "\n".join(facts)
