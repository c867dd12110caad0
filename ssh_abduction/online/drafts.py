"""Consistent maps of a trace that grows, for when there is no time to find a minimal map.

A *draft* is a map of fewer steps that goes on like a sketch (`solver/guesses/tree.py`).
A *sketch* is made of all steps; it is larger, and is the last resort.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

from ssh_abduction.checker.checker import check, unchecked
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Action, Step, Trace
from ssh_abduction.solver import Cost, Judging, Sketch
from ssh_abduction.theory.pairs import Pairs
from ssh_abduction.theory.settle import Problem
from ssh_abduction.theory.speedups import row

# At most this many drafts are kept. Each takes time at every step, and mostly one of the first
# goes on for long.
DRAFTS = 3


@dataclass(slots=True)
class Draft:
    """A sketch, and how many of its first steps make a map that no evidence rejects."""

    sketch: Sketch
    passed: int = 0


class Drafts:
    """Drafts and sketches of the steps so far.

    Args:
        problem: The steps so far, and the theory without `auto`.
        judging: Evidence and the checker, for this theory.
    """

    def __init__(self, problem: Problem, judging: Judging) -> None:
        trace, theory, evidence = problem.trace, problem.theory, problem.evidence
        self._theory, self._judging = theory, judging
        self._has_evidence = bool(evidence)
        # Evidence is asked as a sketch grows. The other axioms hold by construction, or the
        # checker is asked about them.
        self._other_axioms = theory.replace(
            without=(*theory.without, *(kind.axiom for kind in evidence))
        )
        self._may_sketch = row("prefixes").holds_for(theory) and not unchecked(theory)
        self._trusts_sketches = row("certain sketches").holds_for(self._other_axioms)
        self._drafts: list[Draft] = []  # the best first
        self._sketches = [Draft(sketch) for sketch in Sketch.all_of(trace.steps[0], theory)]
        for before, step in pairwise(trace.steps):
            assert before.action
            self._sketches = [
                draft for draft in self._sketches if draft.sketch.extend(before.action, step)
            ]

    def __bool__(self) -> bool:
        """Whether there are drafts; sketches do not count."""
        return bool(self._drafts)

    def first(self) -> SSHMap | None:
        """The best draft, whether or not it is consistent."""
        return self._drafts[0].sketch.map() if self._drafts else None

    def maps(self) -> list[SSHMap]:
        """All drafts, the best first."""
        return [draft.sketch.map() for draft in self._drafts]

    def follow(self, action: Action, step: Step) -> None:
        """Keep what a new step, after this action, does not contradict."""
        self._drafts = [draft for draft in self._drafts if draft.sketch.extend(action, step)]
        self._sketches = [draft for draft in self._sketches if draft.sketch.extend(action, step)]

    def add(self, ssh_map: SSHMap, trace: Trace) -> None:
        """Extend a map of the first steps of a trace, unless it contradicts the later ones."""
        if not self._may_sketch:
            return
        known = len(ssh_map.labels)
        sketch = Sketch.beyond(ssh_map, trace.prefix(known), self._theory)
        later = zip(trace.actions[known - 1 :], trace.steps[known:], strict=True)
        if all(sketch.extend(action, step) for action, step in later):
            self._drafts = sorted([*self._drafts, Draft(sketch)], key=self._cost)[:DRAFTS]

    def clear(self) -> None:
        """Drop the drafts, as minimal maps are known."""
        self._drafts = []

    def best(self, trace: Trace, pairs: Pairs) -> SSHMap | None:
        """The best consistent draft, or else a consistent sketch, if there is one."""
        while self._drafts:
            if self._is_consistent(self._drafts[0], trace, pairs):
                return self._drafts[0].sketch.map()
            del self._drafts[0]
        if self._may_sketch:
            for draft in self._sketches:
                if self._is_consistent(draft, trace, pairs):
                    return draft.sketch.map()
        return None

    def _cost(self, draft: Draft) -> tuple[int, ...]:
        return Cost.of(draft.sketch.map()).preferred_by(self._theory)

    def _is_consistent(self, draft: Draft, trace: Trace, pairs: Pairs) -> bool:
        """Whether a draft satisfies the evidence and the other axioms."""
        sketch, steps = draft.sketch, len(trace)
        if self._has_evidence and draft.passed < steps:
            ssh_map = sketch.map()
            place_of = [s.place for s in ssh_map.dstates]
            new = range(draft.passed, steps)
            if not all(pairs.allow(t, sketch.labels, place_of) for t in new):
                return False
            if not self._judging.allows_grown(trace, ssh_map, draft.passed):
                return False
            draft.passed = steps
        if not sketch.certain or not self._trusts_sketches:
            sketch.certain = not check(trace, sketch.map(), self._other_axioms)
        return sketch.certain
