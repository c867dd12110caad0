"""Checks of the axioms of the causal level, which are about dstates and links (C1, C2)."""

from __future__ import annotations

from ssh_abduction.checker.reading import Check, Found, Reading
from ssh_abduction.data.trace import View


def functional_view(m: Reading) -> Found:
    """Check that each dstate has one view (C1)."""
    known: dict[int, tuple[View | None, int]] = {}
    for (s, view), i in m.views.items():
        first, at = known.setdefault(s, (view, i))
        if view != first:
            yield (
                (at, i),
                f"Dstate {s} looks like {first!r} at step {at} and like {view!r} at step {i}.",
            )


def deterministic(m: Reading) -> Found:
    """Check that an action done at a dstate always leads to the same dstate (C2)."""
    known: dict[tuple[int, str], tuple[int, int]] = {}
    for (source, action, target), i in m.links.items():
        first, at = known.setdefault((source, action), (target, i))
        if target != first:
            yield (
                (at, at + 1, i, i + 1),
                f"{action!r} in dstate {source} leads to dstate {first} at step {at}, and to "
                f"dstate {target} at step {i}.",
            )


AXIOMS: dict[str, Check] = {check.__name__: check for check in (functional_view, deterministic)}
