"""Keeps the minimal maps of a trace current, step by step, while the robot drives.

>>> from ssh_abduction import OnlineMapper, Theory
>>> mapper = OnlineMapper("end", Theory.topological())
>>> walk = [("travel", "hall"), ("travel", "end"), ("around", "end"), ("travel", "hall")]
>>> for action, view in walk:
...     solution = mapper.observe(action, view)
>>> solution.status.value, solution.count, solution.cost.dstates, solution.complete
('optimal', 2, 5, True)

Most steps are replayed, without asking clingo
----------------------------------------------
Let M be all minimal maps of the steps so far, of cost c. A map *predicts* a new step if it has a
link for the action at the robot's dstate, and the dstate at its end shows what is seen. If that
dstate shows something else, the map *contradicts* the step. If the map has no such link, the step
is *unknown* to it.

*Claim.* If some map of M predicts the step and it is unknown to none, then the maps that predict
it are all minimal maps of the longer trace.

*Proof.* By (1) of the claim in `solver/prefixes.py`, no map of the longer trace costs less than c.
A map that predicts the step costs c, by (2). Conversely let F be a minimal map of the longer trace.
It costs c and, cut by the last step, is a map R of M, by (3). R does not contradict the step:
actions are deterministic, and a dstate has one observation, by functional_view and the axioms of
the stars (openings seen). (`observation` reads a star as these axioms do: a rotated pattern is no
contradiction.) So R predicts the step, and F is the replayed R, by (3). ∎

Otherwise clingo is asked, in the one control that is kept. It is asked for all maps of cost c if
some map of M predicts the step, and else for the minimum, which is at least the last proven bound.
If prefixes are not exact for a theory (`theory/speedups.py`), solve the trace again at each step.

*Evidence* may also contradict a map that predicts the step: the new step is not where the map says,
or cannot be there together with other returns. The proof stays the same, as what evidence says of
fewer steps it also says of more. So evidence is asked about returns to the new step only.

A theory that depends on the trace
----------------------------------
Two parts of a theory depend on the whole trace, so they may change as it grows. Displacements
are used from the first one on; from then on places are preferred to paths. And the probability of
rejecting a true map is shared among the returns that may be true; their number is rounded up to a
power of two. When either changes, the minimal maps so far may not be minimal any more, so
they are searched again. That happens once for each doubling. Then less is rejected, so the maps
so far go on as drafts.

When time is short
------------------
A map that predicts the step is minimal even if there is no time to look for others. When no map
predicts the step and time is short, the answer is feasible: a consistent map, and the last bound,
which holds for the longer trace by (1). The map is a draft (`drafts.py`), or one that is guessed or
mended (`guesser.py`). clingo is asked again when the trace has grown (`incremental.py`). It goes on
from the state in which it stopped, and may prove a map minimal again.

If faults are allowed
---------------------
Then `recovery.py` keeps the maps. If all maps are contradicted, it says what broke, keeps a belief
over what may be true, and restores the map. `standing` says how sure it is.
"""

from __future__ import annotations

import importlib
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from ssh_abduction.data.errors import TheoryError, TraceError, brief
from ssh_abduction.data.odometry import Odometry
from ssh_abduction.data.trace import Action, Step, Trace, View
from ssh_abduction.online.keeper import MapKeeper
from ssh_abduction.online.options import StepOptions
from ssh_abduction.online.settler import TheorySettler
from ssh_abduction.runtime.deprecated import renamed_parameters
from ssh_abduction.solver import Solution, check_limit
from ssh_abduction.theory.speedups import ALL, Speedups, checked_speedups, row
from ssh_abduction.theory.theory import Theory, checked_theory

if TYPE_CHECKING:
    from ssh_abduction.online.recovery import Recovery
    from ssh_abduction.online.standing import Standing


class OnlineMapper:
    """Keeps the minimal maps current while a robot drives.

    Args:
        view: What is seen at first.
        theory: Which axioms and which preference; Theory.topological() by default. With faults
            (misread, slipped) `standing` says how sure the map is. The first step decides
            star=auto, and the first displacement decides displacement=auto.
        star: The openings seen at first, as in Step, if the theory uses stars.
        confidence: Probability that the first view and star are right, as in Step. For theories
            with faults.
        odometry: Errors of displacements that come without a covariance, as in Trace; None for the
            defaults.
        time_limit: Seconds that a step may take, about, as clingo cannot be stopped while it
            grounds a step. None waits for the exact answer.
        max_maps: Keep at most this many maps; None keeps all.
        speedups: Which speed-ups are on; none changes the answer.

    Attributes:
        trace: The steps so far.
        theory: The theory, without `auto`.
        solution: The answer for the steps so far.
    """

    @renamed_parameters("limit", "maps")
    def __init__(
        self,
        view: View,
        theory: Theory | None = None,
        *,
        star: Sequence[float] | None = None,
        confidence: float | None = None,
        odometry: Odometry | Mapping[str, Any] | None = None,
        time_limit: float | None = 0.5,
        max_maps: int | None = 100,
        speedups: Speedups = ALL,
    ) -> None:
        first = replace(Step.of(_known(view, 0), star, "step 0"), confidence=confidence)
        theory = checked_theory(theory)
        if theory.jumped:
            raise TheoryError(
                "jumped: expected displacements that hold while a robot drives; leave it out, "
                "and give no displacement at a step where the odometry is lost"
            )
        check_limit("time_limit", "seconds", time_limit)
        checked_speedups(speedups)
        self._odometry = None if odometry is None else Odometry.of(odometry)
        self._steps = [first]
        self._actions: dict[str, Action] = {}
        self.trace = Trace((first,), odometry=self._odometry)
        self._settler = TheorySettler(theory, self.trace)
        self._problem = self._settler.settled(self.trace)
        options = StepOptions(time_limit, max_maps, speedups)
        self._keeper: MapKeeper | Recovery
        if theory.has_faults:
            from ssh_abduction.online.recovery import Recovery  # loads numpy

            began = time.perf_counter()
            self._keeper = Recovery(self._problem, options)
        else:
            _preload_engine(self.theory)
            began = time.perf_counter()
            self._keeper = MapKeeper(self._problem, options)
        self.solution = self._keeper.answer(began)

    @property
    def theory(self) -> Theory:
        """The theory for the steps so far, without `auto`."""
        return self._problem.theory

    @property
    def searches(self) -> int:
        """The number of calls of clingo."""
        return self._keeper.searches

    @property
    def standing(self) -> Standing:
        """How sure the map is, what broke, and what may be true.

        Raises:
            TheoryError: The theory has no faults. Then `solution` says everything.
        """
        if self._keeper.standing is None:
            raise TheoryError(
                "theory: expected faults, as without them nothing is disbelieved, got none; "
                "take misread or slipped, or read the solution"
            )
        return self._keeper.standing

    def __repr__(self) -> str:
        cost = self.solution.cost
        dstates = cost.dstates if cost else "no"
        status = self.solution.status.value
        return f"<OnlineMapper: {len(self._steps)} steps, {status}, {dstates} dstates>"

    def observe(
        self,
        action: Action | str | Mapping[str, Any],
        view: View,
        *,
        star: Sequence[float] | None = None,
        displacement: Sequence[float] | None = None,
        covariance: Sequence[Sequence[float]] | None = None,
        confidence: float | None = None,
    ) -> Solution:
        """Take in an action and what is seen after it, and return the minimal maps.

        Args:
            action: What the robot did.
            view: What it sees now.
            star: The openings that it sees now, if the theory uses stars.
            displacement: [dx, dy, dtheta] of the action, in metres and radians, as in Step; None
                if it is unknown.
            covariance: Of the displacement, (3, 3); None takes it from the odometry.
            confidence: Probability that the view and the star are right, as in Step. It scales
                what it costs to ignore them.

        Raises:
            TraceError: The step does not fit the theory or the trace. The mapper stays as it was.
        """
        began = time.perf_counter()
        done, number = Action.of(action), len(self._steps)
        step = Step.of(
            _known(view, number),
            star,
            f"step {number}",
            displacement=displacement,
            covariance=covariance,
        )
        self._append(done, replace(step, confidence=confidence))
        # A longer trace may change the theory; then search for the maps again.
        if self._settler.is_settled(self._problem, self.trace):
            self._problem = self._problem.changed(self.trace)
            self._keeper.take(self._problem)
        else:
            self._problem = self._settler.settled(self.trace, self._problem)
            self._keeper = self._keeper.restarted(self._problem)
        self.solution = self._keeper.answer(began)
        return self.solution

    def _append(self, action: Action, step: Step) -> None:
        """Append a step to the trace. Raises TraceError if it does not fit."""
        last, number = replace(self._steps[-1], action=action), len(self._steps)
        known = self._actions.get(action.name, action)
        if known != action:
            raise TraceError(
                f"step {number - 1}: action: {brief(action.name)} has kind {action.kind}, "
                f"turn {action.turn} here but kind {known.kind}, turn {known.turn} before; "
                "give the two different names, or the same kind"
            )
        self.theory.require(last, f"step {number - 1}")
        self.theory.require(step, f"step {number}")
        self._settler.check_star(step, number)
        self._actions[action.name] = action
        self._steps[-1:] = [last, step]
        self.trace = Trace(tuple(self._steps), odometry=self._odometry)


def _known(view: View, step: int) -> View:
    """The view of a step. Raises TraceError if it is unknown, which only whole traces allow."""
    if view is None:
        raise TraceError(
            f"step {step}: view: expected one while a robot drives, got none; "
            "log the trace, and solve it as a whole"
        )
    return view


def _preload_engine(theory: Theory) -> None:
    """Import the engine before the first step, so that no step has to wait for the import."""
    if theory.level == "causal":
        importlib.import_module("ssh_abduction.solver.engines.causal")
    elif row("visits").holds_for(theory):
        importlib.import_module("ssh_abduction.online.background_guess")
