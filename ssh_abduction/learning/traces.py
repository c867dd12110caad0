"""Several traces of one world, as one table of images."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from perception.appearance import features_of
from perception.confidence import nearest_views
from perception.errors import PerceptionError
from perception.images import images_of
from ssh_abduction.data.errors import TraceError, brief
from ssh_abduction.data.trace import Trace
from ssh_abduction.learning.runner_up import with_runner_up

Integers = NDArray[np.intp]


@dataclass(frozen=True)
class Traces:
    """Traces of one world. Their steps are counted one after the other, n in all."""

    each: tuple[Trace, ...]

    @classmethod
    def of(cls, given: Any) -> Traces:
        """One trace, or several. Raises TraceError for anything else."""
        if isinstance(given, Traces):
            return given
        each: tuple[Any, ...] = ()
        if isinstance(given, Trace):
            each = (given,)
        elif isinstance(given, Sequence) and not isinstance(given, str):
            each = tuple(given)
        if not each or not all(isinstance(trace, Trace) for trace in each):
            raise TraceError(
                f"traces: expected a Trace, or a list of them, got {brief(given)}; "
                "make one with Trace.load or Trace.from_steps"
            )
        return cls(each)

    @classmethod
    def are(cls, given: Any) -> bool:
        """Whether something is a trace, or traces."""
        return isinstance(given, Traces | Trace) or (
            isinstance(given, Sequence) and len(given) > 0 and isinstance(given[0], Trace)
        )

    @cached_property
    def images(self) -> NDArray[np.float64]:
        """The images of all steps, (n, d).

        Raises:
            PerceptionError: A step has no image, or traces have images of different lengths.
        """
        tables = [images_of(trace) for trace in self.each]
        for i, table in enumerate(tables):
            if table.shape[1] != tables[0].shape[1]:
                raise PerceptionError(
                    f"trace {i}: image: expected {tables[0].shape[1]} ranges, as trace 0 has, "
                    f"got {table.shape[1]}; take traces of one laser"
                )
        return np.concatenate(tables)

    @property
    def features(self) -> Any:
        """What makes features of the images, not fitted yet.

        Raises:
            PerceptionError: The traces have images of different kinds or shapes.
        """
        kinds = [features_of(trace) for trace in self.each]
        for i, kind in enumerate(kinds):
            if (type(kind), kind.get_params()) != (type(kinds[0]), kinds[0].get_params()):
                raise PerceptionError(
                    f"trace {i}: image: expected one of the kind that trace 0 has, got {kind}, "
                    f"not {kinds[0]}; take traces of one sensor"
                )
        return kinds[0]

    @property
    def longest(self) -> int:
        """The index of the longest trace, the first of several."""
        return max(range(len(self.each)), key=lambda i: (len(self.each[i]), -i))

    def at_longest(self, steps: Sequence[int]) -> Integers:
        """The indices among all steps of some steps of the longest trace."""
        before = sum(len(trace) for trace in self.each[: self.longest])
        return before + np.asarray(steps, np.intp)

    def parts(self, of_all: NDArray[Any]) -> list[NDArray[Any]]:
        """An array of all steps, (n, …), split trace by trace."""
        return np.split(of_all, np.cumsum([len(trace) for trace in self.each])[:-1])

    def with_views(
        self,
        images: NDArray[np.float64],
        views: Integers,
        second: Integers | None,
        sure: NDArray[np.float64] | None = None,
    ) -> Traces:
        """These traces with views.

        Noise gets the view of the nearest centre, and the confidence 0.

        Args:
            images: The features of all images, (n, d).
            views: The view of each step, (n,); -1 for noise.
            second: The views of the runner-up, (n,), if there is one.
            sure: How sure each view is, (n,), from 0 to 1; None leaves that out.
        """
        of_steps = np.ones(len(images)) if sure is None else sure.round(4)
        parts = zip(
            self.each, self.parts(nearest_views(images, views)), self.parts(of_steps), strict=True
        )
        seen = [
            trace.with_views(part.tolist(), None if sure is None else c.tolist())
            for trace, part, c in parts
        ]
        others = (
            [None] * len(seen) if second is None else [part.tolist() for part in self.parts(second)]
        )
        return Traces(
            tuple(with_runner_up(t, other) for t, other in zip(seen, others, strict=True))
        )
