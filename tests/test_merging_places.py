"""Places at one position are merged if that makes a map cheaper (costs/merging_places.py)."""

from __future__ import annotations

import math
from unittest.mock import patch

from ssh_abduction import Theory, Trace
from ssh_abduction.data import Odometry
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.robot_logs.log_maps import PATHS
from ssh_abduction.solver.candidates import Candidates
from ssh_abduction.solver.costs.merging_places import with_merged_places
from ssh_abduction.solver.costs.misfit import Misfit
from ssh_abduction.solver.costs.weighing import Weighing
from ssh_abduction.solver.guesses.completing import completed
from ssh_abduction.solver.parts import Parts
from ssh_abduction.solver.start import Limits, Start
from ssh_abduction.theory.settle import settle
from ssh_abduction.theory.speedups import Speedups

THEORY = Theory.topological().replace(star="none", without=PATHS)
# A corridor that is driven twice, with a stop halfway at the second time, as visits and as places.
VISITS, PLACES = [0, 1, 1, 2, 2, 3, 4], [0, 1, 1, 0, 0, 2, 1]


def corridor(offset: float = 0.2) -> Trace:
    actions = ["travel", "around", "travel", "around", "travel", "travel"]
    moves = [(far, 0.0, 0.0 if far else math.pi) for far in (10.0, 0.0, 10.0, 0.0, 5.0, 5.0)]
    noise = Odometry(offset=offset, facing=0.1)
    return Trace.from_steps([0] * 7, actions, displacements=moves, odometry=noise)


def with_places(trace: Trace, places: list[int]) -> SSHMap:
    found = completed(trace, settle(trace, THEORY).theory, range(7), places, [0.0] * 7)
    assert found
    return found


def places_of(ssh_map: SSHMap) -> list[int | None]:
    return [ssh_map.dstates[s].place for s in ssh_map.dstate_at]


def test_places_at_one_position_are_merged() -> None:
    trace = corridor()
    misfit, split = Misfit(settle(trace, THEORY)), with_places(trace, VISITS)
    merged = with_merged_places(split, misfit, lambda found: True)
    assert places_of(merged) == PLACES
    assert misfit.nats_of(merged) < misfit.nats_of(split)


def test_refused_merges_and_exact_positions_change_nothing() -> None:
    trace = corridor()
    misfit, split = Misfit(settle(trace, THEORY)), with_places(trace, VISITS)
    assert with_merged_places(split, misfit, lambda found: False) == split
    exact = Misfit(settle(corridor(offset=0.0), THEORY))
    assert with_merged_places(split, exact, lambda found: True) == split


def test_best_map_of_a_broad_beam_has_merged_places() -> None:
    trace = corridor()
    problem = settle(trace, THEORY)
    parts = Parts(problem, Limits(), Speedups(), None, Start(), 0.0)
    weighing, beam = Weighing(parts), parts.candidates.beam(4)
    assert beam
    with patch.object(Candidates, "maps_of", return_value=[with_places(trace, VISITS)]):
        assert weighing._beams._ends(beam, 4, math.inf)
    assert weighing.best
    assert places_of(weighing.best.map) == PLACES
    assert weighing._beams.found(weighing.best.nats)
