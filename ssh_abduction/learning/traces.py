"""Treat several traces of one world as one sequence of steps, with one table of images."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.neighbors import NearestCentroid

from perception.appearance import features_of
from perception.errors import PerceptionError
from perception.images import images_of
from perception.quality import nearest_views
from ssh_abduction.data.drives import together
from ssh_abduction.data.errors import TraceError, brief, named
from ssh_abduction.data.trace import Trace
from ssh_abduction.learning.runner_up import with_runner_up

Integers = NDArray[np.intp]
# Two traces have common views if at least this share of images look most like their own view in
# the other trace.
ALIKE = 0.5


@dataclass(frozen=True)
class Traces:
    """Traces of one world. Their n steps are numbered one trace after the other."""

    each: tuple[Trace, ...]  # the traces, in the order in which their steps are numbered

    @classmethod
    def of(cls, given: Any) -> Traces:
        """Make Traces of one trace or a sequence of them. Raise TraceError for anything else."""
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
        """Whether a value is a trace, or a sequence that begins with one."""
        return isinstance(given, Traces | Trace) or (
            isinstance(given, Sequence) and len(given) > 0 and isinstance(given[0], Trace)
        )

    @cached_property
    def images(self) -> NDArray[np.float64]:
        """The images of all n steps, (n, d).

        Raises PerceptionError if a step has no image, or one of another length.
        """
        tables = [images_of(trace) for trace in self.each]
        for i, table in enumerate(tables):
            if table.shape[1] != tables[0].shape[1]:
                raise PerceptionError(
                    f"{self._called(i)}: image: expected {tables[0].shape[1]} ranges, as "
                    f"{self._called(0)} has, got {table.shape[1]}; take traces of one laser"
                )
        return np.concatenate(tables)

    @property
    def features(self) -> Any:
        """The transformer of these images to vectors, not fitted yet. Raises PerceptionError."""
        kinds = [features_of(trace) for trace in self.each]
        for i, kind in enumerate(kinds):
            if (type(kind), kind.get_params()) != (type(kinds[0]), kinds[0].get_params()):
                raise PerceptionError(
                    f"{self._called(i)}: image: expected one of the kind that {self._called(0)} "
                    f"has, got {kind}, not {kinds[0]}; take traces of one sensor"
                )
        return kinds[0]

    def _called(self, number: int) -> str:
        """Return the file of a trace, or its number."""
        return named(self.each[number].source or "") or f"trace {number}"

    @property
    def joint(self) -> Trace:
        """The traces as drives of one joint trace, without images. Raises TraceError.

        A single trace is returned as it is.
        """
        if len(self.each) == 1:
            return self.each[0]
        names = [trace.name or "" for trace in self.each]
        if "" in names or len(set(names)) < len(names):
            names = [f"trace {i}" for i in range(len(names))]
        with warnings.catch_warnings():
            # Drives that differ only in their images are no repeats.
            warnings.filterwarnings("ignore", ".* have the same steps", UserWarning)
            return together(map(_without_images, self.each), names)

    def warn_of_unrelated_views(self) -> None:
        """Warn of the first two traces in which one name means views that look different.

        The images of each trace are compared with the mean images of the views of the other. If
        most are nearest to a view of another name, the traces were clustered one by one.
        Traces without images or views are not compared.
        """
        seen = [step for trace in self.each for step in trace.steps]
        if any(step.image is None or step.view is None for step in seen):
            return
        with suppress(PerceptionError):
            images = self.parts(self.features.fit_transform(self.images))
            views = [np.array(trace.views, dtype=object) for trace in self.each]
            for i, j in combinations(range(len(views)), 2):
                alike = _alike(images[i], views[i], images[j], views[j])
                if len(alike) and np.mean(alike) < ALIKE:
                    warnings.warn(
                        f"views: {self._called(i)} and {self._called(j)} seem to have different "
                        f"views of the same names: {alike.sum()} of {len(alike)} images look most "
                        "like the view of the same name in the other trace; cluster the traces "
                        "with cluster --together, or make the map from logs with map --together",
                        stacklevel=2,
                    )
                    return

    def parts(self, of_all: NDArray[Any]) -> list[NDArray[Any]]:
        """Split an array with one row for each step, (n, …), into one array for each trace."""
        return np.split(of_all, np.cumsum([len(trace) for trace in self.each])[:-1])

    def with_images_in(self, file: str) -> Traces:
        """Copy these traces, with image i of all n steps in row i of a sidecar file."""
        rows = self.parts(np.arange(len(self.images)))
        copies = []
        for trace, part in zip(self.each, rows, strict=True):
            numbered = zip(trace.steps, part.tolist(), strict=True)
            steps = tuple(replace(step, image=i) for step, i in numbered)
            copies.append(replace(trace, images=file, steps=steps))
        return Traces(tuple(copies))

    def with_views(
        self,
        images: NDArray[np.float64],
        views: Integers,
        second: Integers | None,
        sure: NDArray[np.float64] | None = None,
    ) -> Traces:
        """Copy these traces with a view, (n,), and its confidence, (n,), if any, at each step.

        `images` has the vector of each image, (n, d). A step without a view (noise, -1) gets the
        view whose centre is nearest to its image. `second` has the runner-up's views, if any.
        """

        def listed(of_all: NDArray[Any] | None) -> list[Any]:
            nothing = [None] * len(self.each)
            return nothing if of_all is None else [part.tolist() for part in self.parts(of_all)]

        columns = (nearest_views(images, views), None if sure is None else sure.round(4), second)
        parts = zip(self.each, *map(listed, columns), strict=True)
        return Traces(
            tuple(
                with_runner_up(trace.with_views(seen, c), other) for trace, seen, c, other in parts
            )
        )


def _alike(
    images: NDArray[np.float64],
    views: NDArray[np.object_],
    others: NDArray[np.float64],
    other_views: NDArray[np.object_],
) -> NDArray[np.bool_]:
    """For each of `others` with a view that both have: is the nearest view its own view?

    The views are compared by their mean image in `images`.
    """
    shared = list({*views} & {*other_views})
    if len(shared) < 2:
        return np.zeros(0, dtype=bool)
    own, compared = np.isin(views, shared), np.isin(other_views, shared)
    means = NearestCentroid().fit(images[own], views[own].astype(str))
    return np.asarray(means.predict(others[compared]) == other_views[compared].astype(str))


def _without_images(trace: Trace) -> Trace:
    """Copy a trace without its images, which may be in files of their own."""
    steps = tuple(replace(step, image=None) for step in trace.steps)
    return replace(trace, steps=steps, images=None)
