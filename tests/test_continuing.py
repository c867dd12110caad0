"""Long traces localised in a map of their first steps (guesses/continuing.py)."""

from __future__ import annotations

from itertools import pairwise
from unittest.mock import patch

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.instances import maze
from ssh_abduction import Theory, Trace, solve
from ssh_abduction.checker.checker import check
from ssh_abduction.data.groups import numbered
from ssh_abduction.solver.asp.facts import answer_maps
from ssh_abduction.solver.guesses import continuing
from ssh_abduction.solver.guesses.continuing import labels_continued
from ssh_abduction.solver.guesses.merging import dstates_merged
from ssh_abduction.solver.steps.chart import Chart
from ssh_abduction.solver.steps.log import Log
from tests.strategies import traces

CAUSAL = Theory.causal()


@settings(max_examples=12)
@given(traces(max_steps=30), st.data())
def test_continued_labels_are_a_consistent_map(trace: Trace, data: st.DataObject) -> None:
    """The given map may be wrong, and few steps may settle a link. Evidence is left out."""
    trace = trace.without_displacements()
    beginning = trace.prefix(data.draw(st.integers(1, len(trace))))
    settings = {
        name: data.draw(st.integers(1, 4)) for name in ("SETTLED", "FOUND", "AHEAD", "LOOKED")
    }
    with patch.multiple(
        continuing,
        WALKS=data.draw(st.integers(0, 30)),
        MANY=data.draw(st.integers(1, 10)),
        **settings,
    ):
        labels = labels_continued(Log(trace, CAUSAL), solve(beginning, CAUSAL).maps[0].labels)
    if labels is not None:
        assert check(trace, answer_maps.causal_map(labels, trace), CAUSAL) == ()


@pytest.mark.parametrize(("steps", "kept"), [(500, False), (800, True), (1200, True)])
def test_map_without_some_links_is_continued_to_all_steps(steps: int, kept: bool) -> None:
    """The labels are kept if the map has enough links. Else a wrong link is found and dropped."""
    walk = maze(4, 4, steps=6000, seed=1)
    known, log = numbered(walk.truth[:steps]), Log(walk.trace, CAUSAL)
    assert len(log.replay(known).labels) < len(walk.trace)
    labels = labels_continued(log, known)
    assert labels is not None
    assert (labels[:steps] == known) == kept
    assert check(walk.trace, answer_maps.causal_map(labels, walk.trace), CAUSAL) == ()
    thin = dstates_merged(Chart.of_steps(log, len(walk.trace)), labels)
    assert check(walk.trace, answer_maps.causal_map(thin, walk.trace), CAUSAL) == ()
    assert len(set(thin)) <= len(set(walk.truth))


def test_map_of_too_few_steps_is_not_continued() -> None:
    walk = maze(4, 4, steps=6000, seed=1)
    assert labels_continued(Log(walk.trace, CAUSAL), numbered(walk.truth[:10])) is None


def test_map_with_all_links_is_replayed() -> None:
    """Known links are followed without a prediction."""
    walk = maze(3, 3, steps=2000, seed=0)
    log = Log(walk.trace, CAUSAL)
    with patch.object(continuing._Map, "_predicting", side_effect=AssertionError):
        labels = labels_continued(log, numbered(walk.truth[:1500]))
    leads = {
        (here, action): there
        for (here, there), action in zip(pairwise(labels or ()), log.actions, strict=True)
    }
    assert labels == numbered(walk.truth)
    assert len(leads) == len(
        {(here, action) for here, action in zip(walk.truth[:-1], log.actions, strict=True)}
    )
