"""Maps of a whole trace that nothing proves to be minimal: they pass the checker, and clingo has to better them."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator

from ssh_abduction.asp import facts
from ssh_abduction.asp.limits import LimitError
from ssh_abduction.engines.base import Found, Task
from ssh_abduction.guesses.tree import Sketch
from ssh_abduction.judge.checker import unchecked
from ssh_abduction.logs import log_of
from ssh_abduction.maps import SSHMap
from ssh_abduction.solver.judging import Judging
from ssh_abduction.solver.known import Known
from ssh_abduction.theory.speedups import Speedups

_log = log_of(__name__)

FRAMING = 30.0  # Maps with frames are sought for so many seconds at most: what they are good for is mostly found by then.
FRAMING_SHARE = 0.4  # Or for such a share of the time that is left, if that is less, so that clingo has the larger part.
UNMAPPED = 2.0  # Until there is any map that may take so many times as long, as any map is worth more than a better one.


class Candidates:
    """Makes maps of the whole trace, and keeps each that is better than the best one known, and that the checker accepts."""

    def __init__(self, task: Task, known: Known, judging: Judging, report: Callable[[], None]) -> None:
        self._task, self._known, self._judging, self._report = task, known, judging, report
        self._sketching = (
            threading.Lock()
        )  # so that who asks for a snapshot waits for a sketch that is nearly done, rather than make another one

    def merge(self) -> None:
        """Make a causal map by merging steps greedily: at once, and not minimal."""
        if self._task.speedups.greedy and self._task.theory.level == "causal":
            self.offer(facts.causal_map(self._task.log.merged(), self._task.trace))

    def sketch(self) -> None:
        """Where no map of the whole trace is known yet, make some without a search: what goes on beyond the best map of a prefix, or a sketch of all steps."""
        with self._sketching:
            if self._known.best is None and self._task.speedups.greedy and not unchecked(self._task.theory):
                self._sketch_anew()

    def _sketch_anew(self) -> None:
        self.merge()
        if self._known.best is not None:
            return
        for sketch in self._beyond_prefix():
            if self._goes_on_to_end(sketch):
                self.offer(sketch.map())
        for sketch in Sketch.all_of(self._task.trace.steps[0], self._task.theory):
            if self._goes_on_to_end(sketch):
                self.offer(sketch.map())
                return

    def _beyond_prefix(self) -> Iterator[Sketch]:
        partial = self._known.partial
        if partial:
            yield Sketch.beyond(partial, self._task.trace.prefix(len(partial.labels)), self._task.theory)

    def _goes_on_to_end(self, sketch: Sketch) -> bool:
        trace, done = self._task.trace, len(sketch.labels)
        later = zip(trace.actions[done - 1 :], trace.steps[done:], strict=True)
        return all(sketch.extend(action, step) for action, step in later)

    def frame(self, speedups: Speedups) -> None:
        """Make maps in which places have frames, though the theory does not ask for any.

        speedups  those that the caller of the search has on: other ones than here may hold where places have frames
        """
        from ssh_abduction.engines.framing import maps_with_frames  # loads numpy

        watch = self._task.watch
        seconds = min(FRAMING, FRAMING_SHARE * watch.left())
        part = watch.part(UNMAPPED * seconds)
        try:
            for ssh_map in maps_with_frames(self._task.trace, self._task.theory, part, speedups):
                part.shorten(seconds)
                self.offer(ssh_map)
                self._report()
        except LimitError:
            watch.check()

    def offer(self, ssh_map: SSHMap) -> None:
        """Keep a map of the whole trace if it is better than the best one known, and satisfies all axioms."""
        found = Found.of(ssh_map, self._task.theory)
        if self._known.is_better(found) and self._judging.accepts(ssh_map):
            _log.info("candidate of %d dstates, %d places, %d paths", len(ssh_map.dstates), len(ssh_map.places), len(ssh_map.paths))
            self._known.keep(found, ssh_map.labels)
            self._task.watch.use_reserve()
