"""Maps of a growing trace that satisfy the axioms, for when finding a minimal map takes too long.

A dstate (distinctive state) is a place and a heading. A *sketch* (`solver/guesses/tree.py`) is
made without a search: a step gets a new dstate unless the axioms imply at which known dstate it is.
A *draft* is a sketch that begins with a good map of the first steps. A sketch that begins at the
first step is mostly larger than a draft. It is used if there is no draft.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

from ssh_abduction.checker.checker import check, unchecked
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Action, Step, Trace
from ssh_abduction.solver import Cost, Judging, Sketch, sketch_beyond, sketches_of
from ssh_abduction.theory.pairs import Pairs
from ssh_abduction.theory.settle import Problem
from ssh_abduction.theory.speedups import row

# Keep at most this many drafts, as each takes time at every step. Mostly at least one of the best
# drafts remains consistent for long.
DRAFTS = 3


@dataclass(slots=True)
class Draft:
    """A sketch, with the progress of testing it against the evidence.

    Attributes:
        sketch: The sketch.
        passed: The number of first steps for which no evidence rejected it.
    """

    sketch: Sketch
    passed: int = 0


class Drafts:
    """Keeps drafts and sketches of the steps so far.

    Args:
        problem: The steps so far, and the theory, in which no field is "auto".
        judging: Judges maps by the evidence and the checker, for this theory.
    """

    def __init__(self, problem: Problem, judging: Judging) -> None:
        trace, theory, evidence = problem.trace, problem.theory, problem.evidence
        self._theory, self._judging = theory, judging
        self._has_evidence = bool(evidence)
        # Evidence judges a sketch as it grows. The other axioms hold by construction, or the
        # checker judges them.
        self._other_axioms = theory.replace(
            without=(*theory.without, *(kind.axiom for kind in evidence))
        )
        self._may_sketch = row("prefixes").holds_for(theory) and not unchecked(theory)
        self._trusts_sketches = row("certain sketches").holds_for(self._other_axioms)
        self._drafts: list[Draft] = []  # the best first
        self._sketches = [Draft(sketch) for sketch in sketches_of(trace.steps[0], theory)]
        for before, step in pairwise(trace.steps):
            assert before.action
            self._sketches = [
                draft for draft in self._sketches if draft.sketch.extend(before.action, step)
            ]

    def __bool__(self) -> bool:
        """Whether there are drafts; sketches do not count."""
        return bool(self._drafts)

    def first(self) -> SSHMap | None:
        """Return the map of the best draft. It need not be consistent. None without a draft."""
        return self._drafts[0].sketch.map() if self._drafts else None

    def maps(self) -> list[SSHMap]:
        """Return the maps of all drafts, the best first. They need not be consistent."""
        return [draft.sketch.map() for draft in self._drafts]

    def follow(self, action: Action, step: Step) -> None:
        """Extend drafts and sketches by a step, and drop those that it contradicts.

        Args:
            action: The action before the step.
            step: The new step.
        """
        self._drafts = [draft for draft in self._drafts if draft.sketch.extend(action, step)]
        self._sketches = [draft for draft in self._sketches if draft.sketch.extend(action, step)]

    def add(self, ssh_map: SSHMap, trace: Trace) -> None:
        """Make a draft of a map of the first steps, unless the later steps contradict it.

        Args:
            ssh_map: The map.
            trace: All steps so far.
        """
        if not self._may_sketch:
            return
        known = len(ssh_map.dstate_at)
        sketch = sketch_beyond(ssh_map, trace.prefix(known), self._theory)
        later = zip(trace.actions[known - 1 :], trace.steps[known:], strict=True)
        if all(sketch.extend(action, step) for action, step in later):
            self._drafts = sorted([*self._drafts, Draft(sketch)], key=self._cost)[:DRAFTS]

    def clear(self) -> None:
        """Drop all drafts. The sketches stay."""
        self._drafts = []

    def best(self, trace: Trace, pairs: Pairs) -> SSHMap | None:
        """Return the map of the best consistent draft, else of a consistent sketch, else None.

        Drafts that turn out to be inconsistent are dropped.

        Args:
            trace: The steps so far.
            pairs: What the evidence says about pairs of these steps.
        """
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
        """Count what the theory minimises in a draft."""
        return Cost.of(draft.sketch.map()).preferred_by(self._theory)

    def _is_consistent(self, draft: Draft, trace: Trace, pairs: Pairs) -> bool:
        """Whether a draft satisfies the evidence and all other axioms."""
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
