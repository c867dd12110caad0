"""Any two searches that say `complete` list the same maps, whatever their limits and speed-ups.

Each search of these tests has a random subset of the speed-ups, and perhaps a limit of work. So the
work of a test is bounded, and does not depend on the machine. Complete answers are compared with
all maps of the brute force. Of the other answers, each claim is checked: by the checker, and by the
least cost that the brute force finds.
"""

from __future__ import annotations

from collections.abc import Set
from pathlib import Path
from unittest.mock import patch

import pytest
from brute_force import Key, key, minimal_maps
from hypothesis import given, settings
from hypothesis import strategies as st
from instances import maze, moore
from strategies import TOYS, theories, traces
from test_weighing import EQUAL, cheapest, weighed

from ssh_abduction import Solution, Theory, Trace, solve
from ssh_abduction.checker.checker import check
from ssh_abduction.cli import main
from ssh_abduction.robot_logs.log_maps import BARE
from ssh_abduction.solution import Status
from ssh_abduction.solver.sources.exact import choosing, prefixes
from ssh_abduction.theory.speedups import SPEEDUPS, Speedups

WORK = st.sampled_from([0.003, 0.02, 1.0])  # the small ones end some searches early
IMPOSSIBLE = 1e-9  # the p-value of the fit of a map that cannot be true
FEW = 50  # as many maps are listed and checked without a limit
subsets = st.sets(st.sampled_from(SPEEDUPS)) | st.just(set[str]())


def searched(
    data: st.DataObject, trace: Trace, theory: Theory, folder: Path, work: float, few: bool = True
) -> Solution:
    """Solve with a random subset of the speed-ups, and check the answer and its claims."""
    off = data.draw(subsets, label="speed-ups that are off")
    most = data.draw(st.sampled_from([1, 3, None if few else 20]), label="most maps")
    found = solve(trace, theory, max_maps=most, work_limit=work, speedups=Speedups.without(off))
    for ssh_map in found.maps:
        assert check(trace, ssh_map, theory) == ()
    # The misfit of a map that cannot be true may have several minima, and each method finds one.
    fits = [ssh_map.fit.p for ssh_map in found.maps if ssh_map.fit]
    if found.maps and min(fits, default=1.0) > IMPOSSIBLE:
        found.save(folder / "maps.json")
        assert main(["check", str(folder / "maps.json")]) == 0
    assert len(set(found.maps)) == found.count
    assert not (found.complete and found.stopped)
    return found


def is_right(found: Solution, expected: Set[Key]) -> None:
    """Compare an answer with the minimal maps of the brute force."""
    listed = {key(ssh_map) for ssh_map in found.maps}
    if found.complete:
        assert listed == expected
    if found.status is Status.OPTIMAL:
        assert listed <= expected
    if found.status is Status.UNSATISFIABLE:
        assert not expected
    if found.maps:
        assert expected


@settings(max_examples=24)
@given(work=WORK, data=st.data())
def test_counted_maps_do_not_depend_on_the_search(
    work: float, data: st.DataObject, tmp_path_factory: pytest.TempPathFactory
) -> None:
    trace = data.draw(traces(max_steps=6, closures=True), label="trace")
    theory = data.draw(theories(trace), label="theory").replace(weigh="count")
    first = data.draw(st.sampled_from([1, 3, prefixes.FIRST_PREFIX]), label="first prefix")
    few = data.draw(st.sampled_from([0, choosing.FEW_STEPS]), label="few steps")
    toys = [toy for toy in TOYS if toy.rules in theory.rules]
    counts, expected = minimal_maps(trace, theory, lambda one: all(t.allows(one) for t in toys))
    with (
        patch.multiple(prefixes, FIRST_PREFIX=first),
        patch.multiple(choosing, FEW_STEPS=few),
    ):
        folder = tmp_path_factory.mktemp("maps")
        found = searched(data, trace, theory, folder, work, len(expected) <= FEW)
    is_right(found, expected)
    for name in theory.priorities[:1] if counts else ():
        assert (getattr(found.bound, name) or 0) <= getattr(counts, name)


@pytest.mark.parametrize("of_logs", [False, True])
@settings(max_examples=18)
@given(work=WORK, data=st.data())
def test_weighed_maps_do_not_depend_on_the_search(
    of_logs: bool, work: float, data: st.DataObject, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """Also with the theories of `ssh-abduction map`, which give up all path axioms."""
    trace = data.draw(traces(max_steps=4, closures=True, metric=True), label="trace")
    if of_logs:
        star = data.draw(st.sampled_from(["alike", "none"] if trace.has_stars else ["none"]))
        theory = BARE.replace(star=star)
    else:
        theory = data.draw(theories(trace, fixed=("displacement",)), label="theory")
    if not trace.has_displacements:
        return
    nats, expected = cheapest(trace, weighed(theory))
    found = searched(data, trace, weighed(theory), tmp_path_factory.mktemp("maps"), work)
    is_right(found, expected)
    if found.weighed is not None:
        assert found.weighed.bound <= nats + EQUAL
        assert found.weighed.nats >= nats - EQUAL


@pytest.mark.parametrize(
    ("walk", "theory"),
    [
        (moore(5, 2, steps=40, seed=3), Theory.causal()),
        (maze(2, 2, steps=24, seed=1, stars=True), Theory.topological()),
        (maze(2, 2, steps=16, seed=1), Theory.topological()),
        (maze(3, 3, steps=20, seed=2, stars=True), Theory.topological().replace(path_places=2)),
    ],
    ids=["machine", "framed", "frameless", "declared field"],
)
@settings(max_examples=4)
@given(data=st.data())
def test_longer_traces_have_one_set_of_minimal_maps(
    walk: object, theory: Theory, data: st.DataObject, tmp_path_factory: pytest.TempPathFactory
) -> None:
    trace, folder = walk.trace, tmp_path_factory.mktemp("maps")
    answers = [searched(data, trace, theory, folder, work) for work in (0.05, 1.0)]
    answers.append(solve(trace, theory, max_maps=None, work_limit=3.0))
    complete = [found for found in answers if found.complete]
    assert complete, "the work limit is too small for this trace"
    listed = [{key(ssh_map) for ssh_map in found.maps} for found in complete]
    assert listed == listed[:1] * len(listed)
    for found in answers:
        assert (found.bound.dstates or 0) <= complete[0].bound.dstates
        if found.status is Status.OPTIMAL:
            assert {key(ssh_map) for ssh_map in found.maps} <= listed[0]
