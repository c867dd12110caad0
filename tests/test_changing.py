"""Local changes of a map find a cheaper one."""

from __future__ import annotations

import math

import pytest
import truth

from ssh_abduction import Theory
from ssh_abduction.checker.checker import violations
from ssh_abduction.data import Odometry
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.solver.costs.changing import Changing
from ssh_abduction.solver.costs.misfit import Misfit
from ssh_abduction.solver.sources.metric.completing import completed
from ssh_abduction.solver.steps.log import Log
from ssh_abduction.theory.settle import settle


@pytest.mark.parametrize("star", ["none", "auto"])
@pytest.mark.parametrize("seed", [1, 4])
def test_changes_join_a_visit_that_a_map_keeps_apart(seed: int, star: str) -> None:
    """The map is the true one, but the last visit is to a new place."""
    (known,) = truth.mazes(3, 20, [seed], truth.Noise(Odometry()))
    problem = settle(known.trace, Theory.topological().replace(star=star))
    misfit, places = Misfit(problem), truth.partition(known.places)
    start = max(t for t, place in enumerate(places) if place != places[-1]) + 1
    is_last = [t >= start for t in range(len(places))]
    labels = truth.partition([*zip(known.dstates, is_last, strict=True)])
    at = truth.partition([*zip(places, is_last, strict=True)])
    of_dstate = [*dict(zip(labels, at, strict=True)).values()]
    facing = [-math.pi / 2 * state[2] for state in known.dstates]
    facing = [*dict(zip(labels, facing, strict=True)).values()]
    begin = completed(known.trace, problem.theory, labels, of_dstate, facing)
    assert begin is not None
    found: dict[float, SSHMap] = {}

    def add(ssh_map: SSHMap) -> float:
        assert not [*violations(known.trace, ssh_map, problem.theory)]
        found[nats := misfit.nats_of(ssh_map)] = ssh_map
        return nats

    log = Log(known.trace, problem.theory, problem.pairs)
    Changing(problem, log, misfit, add, 3.0).improve(begin)
    assert truth.is_true(found[min(found)], known)
    assert min(found) < misfit.nats_of(begin) - 2
