"""Make maps of the whole trace quickly, without a proof that they are minimal.

Only maps that the checker accepts are kept. Clingo then only has to find better ones.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence, Set
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

from ssh_abduction.checker.checker import violations
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Trace
from ssh_abduction.runtime.clock import STARVED, heeding
from ssh_abduction.runtime.limits import LimitError, Watch, processor_clock
from ssh_abduction.runtime.loggers import log_of
from ssh_abduction.solution.values import Found
from ssh_abduction.solver.asp import facts
from ssh_abduction.solver.board import Judging, Known, projected
from ssh_abduction.solver.schedule import turn
from ssh_abduction.solver.sources.exact.engine import Task
from ssh_abduction.solver.sources.symbolic.sketch import (
    Sketch,
    first_contradiction,
    mended_sketch,
    sketch_beyond,
    sketches_of,
)
from ssh_abduction.theory.speedups import Speedups
from ssh_abduction.theory.theory import Theory

if TYPE_CHECKING:
    from ssh_abduction.solver.geometry.poses import Poses
    from ssh_abduction.solver.sources.metric.beam import Beam
    from ssh_abduction.solver.sources.metric.joint_drives import Joining

_log = log_of(__name__)

# Look for maps with frames for UNMAPPED times as long if no map is known.
UNMAPPED = 2.0
# The sketch that succeeds most often may take this many seconds of processor time even if less time
# is left. Otherwise a slow or busy machine would find no map.
SUREST = 1.0
# Make a beam of hypotheses only for at most this many steps, as its time grows with the cube of
# their number.
LONGEST = 2000


class Candidates:
    """Makes maps of the whole trace, and keeps the best one that the checker accepts.

    Attributes:
        contradicting: The steps that contradicted maps made without a search. The step of the most
            reliable map comes first.
    """

    def __init__(
        self, task: Task, known: Known, judging: Judging, report: Callable[[], None]
    ) -> None:
        self._task, self._known, self._judging = task, known, judging
        self._report = report
        self._beams: dict[tuple[int, Set[int]], Beam] = {}
        self.contradicting: dict[int, None] = {}
        # A snapshot waits for a sketch under way instead of making another one.
        self._sketching = threading.Lock()

    def merge(self) -> None:
        """Make a causal map by merging steps greedily, if the theory is causal. This is fast."""
        if self._task.speedups.greedy and self._task.theory.level == "causal":
            self.offer(facts.causal_map(self._task.log.merged(), self._task.trace))

    def beam(self, width: int, believed: Set[int] | None = None) -> Beam | None:
        """Return the beam of this many hypotheses about dstates and places.

        It uses only the closures that are `believed`, given by their numbers; None means all.
        Later calls return the same beam, which goes on where it stopped. None without the speed-up
        `greedy`, if the trace is long, or if the checker cannot check all axioms. Only searches
        that weigh maps ask for beams, so the trace has displacements.
        """
        if (
            len(self._task.trace) > LONGEST
            or not self._task.speedups.greedy
            or not self._judging.can_accept
        ):
            return None
        from ssh_abduction.solver.sources.metric.beam import Beam  # loads numpy

        trace = self._task.trace
        believed = {*range(len(trace.closures))} if believed is None else believed
        key = width, frozenset(believed)
        if key not in self._beams:
            closures = tuple(trace.closures[i] for i in sorted(believed))
            problem = self._task.problem.changed(replace(trace, closures=closures))
            self._beams[key] = Beam(problem, self._task.log, width)
        return self._beams[key]

    def accepted(self, maps: Iterable[SSHMap]) -> Iterator[SSHMap]:
        """Yield the maps that the checker accepts."""
        projections = (projected(ssh_map, self._task.theory) for ssh_map in maps)
        yield from filter(self._judging.accepts, projections)

    def accepts(self, ssh_map: SSHMap) -> bool:
        """Whether the checker accepts a map."""
        return self._judging.accepts(projected(ssh_map, self._task.theory))

    def joining(self) -> Joining | None:
        """Return a search that joins the maps of single drives.

        None if lifts or faults within a drive are allowed.
        """
        if not (self._trusts_drives() and self._task.theory.several_drives):
            return None
        from ssh_abduction.solver.sources.metric.joint_drives import Joining  # loads numpy

        return Joining(self._task.problem, self._task.log)

    def smoothed(
        self, begin: tuple[Sequence[int], Sequence[int], Poses] | None = None
    ) -> SSHMap | None:
        """Merge visits at poses that fit all closures, or the dstates and places of `begin`.

        `begin` has the dstate of each step, the place of each dstate, and their equations. None if
        the checker refuses the map. Also None where there are no beams, or with lifts or faults
        within a drive.
        """
        if not self._trusts_drives():
            return None
        from ssh_abduction.solver.sources.metric.overlay import smoothed_map  # loads numpy

        found = smoothed_map(self._task.problem, self._task.log, begin)
        return found if found is not None and self._judging.accepts(found) else None

    def _trusts_drives(self) -> bool:
        """Whether beams suit the trace, without lifts or faults of a drive but misread views."""
        theory = self._task.theory
        misread = 0.0 if theory.star == "none" else theory.misread
        allows = theory.lifts or theory.replace(changed=0.0, misread=misread).has_faults
        return not allows and self.beam(1) is not None

    def go_on(self, beam: Beam) -> None:
        """Extend the partial maps of a beam to the whole trace, the longest first.

        Stop when one is better than the best map so far.
        """
        before = self._known.best
        for first in beam.partial():
            done = self._task.trace.prefix(len(first.dstate_at))
            self._go_on_to_end(sketch_beyond(first, done, self._task.theory, homing=False))
            if self._known.best is not before:
                return

    def sketch(self, seconds: float = math.inf) -> None:
        """Make a sketch (a map without a search), if no map of the whole trace is known.

        A sketch extends the best map of a prefix, or begins at the first step. The sketch with the
        most new dstates is large, but the checker accepts it most often and fastest. So it is tried
        first. Then come the others, the smallest first. With a time limit, stop at the first of
        these that is better than the first sketch. `seconds` are for all sketches, and each may use
        a share of the time left. If another thread makes sketches, wait for it for as long.
        """
        if not self._sketching.acquire(timeout=min(seconds, threading.TIMEOUT_MAX)):
            return
        try:
            if (
                self._known.best is not None
                or not self._task.speedups.greedy
                or not self._judging.can_accept
            ):
                return
            whole = Watch().part(seconds)
            *smaller, surest = self._attempts()
            for attempt in (surest, *smaller):
                # The others take longer than the surest one.
                if self._known.best is not None and whole.left() < whole.elapsed():
                    return
                before = self._known.best
                share = 1.0 if attempt in (surest, *smaller[-1:]) else turn("sketch").share
                part = (
                    Watch().part(max(seconds, SUREST), processor_clock(waiting=STARVED))
                    if attempt is surest
                    else whole.part(share * whole.left())
                )
                with suppress(LimitError), heeding(part.check):
                    attempt()
                if seconds < math.inf and attempt is not surest and self._known.best is not before:
                    return
        finally:
            self._sketching.release()

    def _attempts(self) -> list[Callable[[], None]]:
        """List functions that each make a map without a search. Those for small maps come first."""
        trace, theory, known = self._task.trace, self._task.theory, self._known.partial
        sketches = sketches_of(trace.steps[0], theory)
        if known is not None:
            sketches.insert(0, sketch_beyond(known, trace.prefix(len(known.dstate_at)), theory))
        kinds: list[Callable[[], None]] = [
            partial(self._go_on_to_end, sketch) for sketch in sketches
        ]
        if theory.misread or theory.slipped or theory.jumped:
            kinds.append(self._offer_mended)
        return [self.merge, *kinds]

    def _go_on_to_end(self, sketch: Sketch) -> None:
        """Extend a map to the end of the trace and offer it, unless a step contradicts it.

        If no map is known then, note the step that contradicts this one, or the last step at which
        it breaks an axiom. The next travel may put these steps on a path, so note its end, too.
        """
        wrong = first_contradiction(sketch, self._task.trace)
        if wrong is None:
            self.offer(sketch.map())
            broken = self._judging.broken
            if self._known.best is None and broken is not None and broken.steps:
                wrong = max(broken.steps)
        if wrong is not None:
            actions = enumerate(self._task.trace.actions[wrong:], wrong)
            later = (t + 1 for t, action in actions if action.kind == "travel")
            self.contradicting |= dict.fromkeys((wrong, next(later, wrong)))

    def _offer_mended(self) -> None:
        """Offer a map made without a search. Treat steps that contradict it as wrong."""
        if guess := mended_sketch(self._task.trace, self._task.theory):
            self.offer(guess.map)

    def frame(self, speedups: Speedups) -> None:
        """Offer maps in which places have frames, although the theory does not demand frames."""
        from ssh_abduction.solver.sources.exact.labels_first import maps_with_frames  # loads numpy

        watch = self._task.watch
        seconds = turn("maps with frames").work(watch)
        part = watch.part(UNMAPPED * seconds)
        try:
            with heeding(part.check):
                for ssh_map in maps_with_frames(self._task.problem, part, speedups):
                    part.shorten(seconds)
                    self.offer(ssh_map)
                    self._report()
        except LimitError:
            watch.check()

    def offer(self, ssh_map: SSHMap) -> None:
        """Keep a map of the whole trace if it is the best so far and the checker accepts it."""
        ssh_map = projected(ssh_map, self._task.theory)
        found = Found.of(ssh_map, self._task.theory)
        if self._known.is_better(found) and self._judging.accepts(ssh_map):
            _log.info(
                "candidate of %d dstates, %d places, %d paths",
                len(ssh_map.dstates),
                len(ssh_map.places),
                len(ssh_map.theory_paths),
            )
            self._known.keep(found, ssh_map.dstate_at)


def has_quick_map(trace: Trace, theory: Theory) -> bool:
    """Whether the checker accepts one of the surest maps that are made without a search."""
    return any(
        first_contradiction(sketch, trace) is None
        and next(violations(trace, sketch.map(), theory), None) is None
        for sketch in sketches_of(trace.steps[0], theory)[-2:]
    )
