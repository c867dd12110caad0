"""Routes are the shortest ones, lead where they say, and errors name the range."""

from __future__ import annotations

import json
import random
from dataclasses import replace
from itertools import groupby, product
from pathlib import Path
from typing import Any

import pytest
from worlds import rectangle, written

from ssh_abduction import SSHMap, Theory, Trace, check, route, solve
from ssh_abduction.cli import main
from ssh_abduction.data import Action, MapError
from ssh_abduction.data.map_parts import Fault, Name
from ssh_abduction.data.maps import DState, Fit, MapPath, Pose
from ssh_abduction.robot_logs.log_maps import BARE
from ssh_abduction.solver import with_regions


def random_map(seed: int) -> SSHMap:
    """Links between six dstates by chance, with poses."""
    chance = random.Random(seed)
    links = {
        (s, action, chance.randrange(6))
        for s in range(6)
        for action in "xy"
        if chance.random() < 0.6
    }
    poses = tuple(
        Pose(chance.uniform(1, 9), chance.uniform(1, 9), 0.0, (0.1, 0.0, 0.1)) for _ in range(6)
    )
    dstates = tuple(DState(i, f"v{i}") for i in range(6))
    return SSHMap(
        tuple(range(6)), dstates, tuple(sorted(links)), fit=Fit(0.0, 1, 1.0, poses=poses)
    ).renumbered()


@pytest.mark.parametrize("seed", range(12))
@pytest.mark.parametrize("by", ["actions", "metres"])
def test_route_is_the_shortest_sequence_of_actions(seed: int, by: str) -> None:
    ssh_map = random_map(seed)
    leads = {(s, action): x for s, action, x in ssh_map.links}
    poses = ssh_map.fit.poses if ssh_map.fit else ()
    shortest: dict[int, float] = {}
    for actions in (way for n in range(6) for way in product("xy", repeat=n)):
        here, cost = 0, 0.0
        for action in actions:
            there = leads.get((here, action))
            if there is None:
                break
            cost += (
                1
                if by == "actions"
                else abs(complex(poses[here].x - poses[there].x, poses[here].y - poses[there].y))
            )
            here = there
        else:
            shortest[here] = min(cost, shortest.get(here, cost))
    for goal in range(6):
        if goal not in shortest:
            with pytest.raises(MapError, match="that known links lead to"):
                route(ssh_map, 0, goal, by=by)
            continue
        found = route(ssh_map, 0, goal, by=by)
        assert found.dstates[-1] == goal
        assert found.views == tuple(ssh_map.dstates[s or 0].view for s in found.dstates)
        assert found.is_known
        assert found.metres is not None
        assert (len(found.moves) if by == "actions" else found.metres) == pytest.approx(
            shortest[goal]
        )


def test_route_by_places_uses_a_street_in_reverse(
    square: SSHMap,
) -> None:
    by_links = route(square, 0, "p3")
    by_places = route(square, 0, "p3", by="places")
    assert (len(by_links.moves), by_links.is_known) == (5, True)
    assert (by_places.moves[-1].place, by_places.is_known) == (3, False)
    assert [move.place for move in by_places.moves] == [0, 3]
    assert by_places.moves[0].action is None
    assert (by_places.moves[1].action, by_places.moves[1].view) == ("travel", None)
    assert by_places.metres == pytest.approx(10, abs=0.1)


def test_route_by_places_stays_in_one_piece() -> None:
    """Fewer paths are preferred, so both streets are one path. Nothing observed joins them."""
    drives = [
        Trace.from_steps(views, ["travel"], name=name)
        for views, name in (("ab", "monday"), ("xy", "far"))
    ]
    apart = tuple(product((0, 1), (2, 3)))
    with pytest.warns(UserWarning, match="has no view in common"):
        solution = solve(drives, Theory.topological().replace(elsewhere=apart), max_maps=None)
    assert solution.trace is not None
    for ssh_map in solution.maps:
        assert len(ssh_map.pieces) == 2
        assert len(ssh_map.paths) == 1
        assert not check(solution.trace, ssh_map, solution.theory)
        near, far = (f"p{ssh_map.place_of(t)}" for t in (1, 2))
        assert len(route(ssh_map, 0, near, by="places").moves) == 1
        for by in ("actions", "places"):
            with pytest.raises(MapError, match=r"reach 2 dstates.*; it is in another piece"):
                route(ssh_map, 0, far, by=by)


def test_route_by_places_travels_only_where_the_robot_travelled() -> None:
    """Place 2 is between places 0 and 1 in the order of path 0, but no travel leads there."""
    courses = ((0, 0, 1), (1, 0, 1), (1, 1, 1), (2, 1, 1), (2, 0, 1))
    dstates = tuple(DState(i, f"v{i}", *course) for i, course in enumerate(courses))
    links = ((0, "on", 1), (1, "right", 2), (2, "on", 3), (3, "right", 4))
    paths = MapPath(0, (0, 2, 1)), MapPath(1, (1, 2))
    ssh_map = SSHMap((0, 1, 2, 3, 4), dstates, links, (0, 1, 2), paths)
    assert route(ssh_map, 0, "p2", by="places").places == (0, 1, 1, 2)
    back = route(ssh_map, 4, "p0", by="places")
    assert [*dict.fromkeys(back.places)] == [2, 1, 0]


def test_route_goes_around_avoided_dstates() -> None:
    dstates = tuple(DState(i, "v", i) for i in range(4))
    links = ((0, "a", 1), (1, "a", 3), (0, "b", 2), (2, "b", 0), (2, "c", 2), (2, "a", 1))
    ssh_map = SSHMap((0, 1, 2, 3), dstates, links, (0, 1, 2, 3), (MapPath(0, (0, 1)),))
    assert route(ssh_map, 0, 1).dstates == (0, 1)
    assert route(ssh_map, 0, 1).goal == "dstate 1 at place 1"
    assert route(ssh_map, 0, 3).dstates == (0, 1, 3)
    with pytest.raises(
        MapError,
        match=r"avoid: expected a way around .*, got none to dstate 3 at place 3; avoid less",
    ):
        route(ssh_map, 0, 3, avoid=[1])
    with pytest.raises(MapError, match="of 'to' that is not avoided"):
        route(ssh_map, 0, 3, avoid=["p3"])
    detour = SSHMap(
        ssh_map.labels, dstates, (*links, (2, "d", 3)), (0, 1, 2, 3), (MapPath(0, (0, 1)),)
    )
    assert route(detour, 0, 3, avoid=["p1"]).actions == ("b", "d")


@pytest.mark.parametrize(
    ("slot", "bearing", "headings"), [(0, None, (0, 2, 0, 2)), (None, 35, (30, 210, 50, 230))]
)
@pytest.mark.parametrize("by", ["actions", "places"])
def test_route_passes_no_gateway_that_was_last_seen_closed(
    slot: int | None, bearing: int | None, headings: tuple[int, ...], by: str
) -> None:
    """Two places, and a dstate in each direction at both."""
    courses = zip((0, 0, 1, 1), (1, -1, 1, -1), headings, strict=True)
    dstates = tuple(
        DState(i, f"v{i}", place, 0, way, heading)
        for i, (place, way, heading) in enumerate(courses)
    )
    links = ((0, "on", 2), (0, "turn", 1), (1, "turn", 0), (2, "turn", 3), (3, "on", 1))
    ssh_map = SSHMap((0, 2, 3, 1), dstates, links, (0, 1), (MapPath(0, (0, 1)),))
    shut = Fault(2, "changed", "closed on tuesday", "open on monday", 1.0, 0, slot, bearing=bearing)
    again = replace(shut, step=3, seen="open on wednesday", expected="closed on tuesday")
    for start, goal, actions in ((0, "p1", ("on",)), (2, "p0", ("turn", "on"))):
        assert route(ssh_map, start, goal, by=by).actions == actions
        opened = replace(ssh_map, faults=(shut, again))
        assert route(opened, start, goal, by=by).actions == actions
        with pytest.raises(MapError, match="passes a gateway that was last seen closed"):
            route(replace(ssh_map, faults=(shut,)), start, goal, by=by)


@pytest.mark.parametrize(
    ("actions", "arguments", "said"),
    [
        # One way only: the paths of the map also lead back.
        (["travel"] * 3, {"by": "actions"}, "take --by places: the places of the map imply a way"),
        # Nothing leads back through a lift that was used once.
        (
            ["travel", Action("lift", "lift"), "travel"],
            {},
            "from dstate 3 .*they reach 1 dstate.* no stairs",
        ),
        (["travel", Action("lift", "lift"), "travel"], {"by": "places"}, "implied .* no stairs"),
        (["travel"] * 3, {"by": "places", "avoid": ["p1"]}, "avoid less"),
    ],
)
def test_route_advises_only_what_leads_there(
    actions: list[Any], arguments: dict[str, Any], said: str
) -> None:
    ssh_map = solve(Trace.from_steps("abcd", actions)).maps[0]
    with pytest.raises(MapError, match=said) as error:
        route(ssh_map, **{"start": 3, "goal": "p0", **arguments})
    assert ("--by places" in str(error.value)) == ("--by places" in said)


@pytest.mark.parametrize(("goal", "where"), [(3, "the goal"), ("p3", "at place 3")])
def test_route_to_its_own_start_says_so(goal: int | str, where: str) -> None:
    found = route(solve(Trace.from_steps("abcd", ["travel"] * 3)), None, goal)
    assert found.sentence == f"the start, dstate 3 at place 3, is {where}: there is nothing to do"


def test_route_counts_rivals_that_agree() -> None:
    corridor = Trace.from_steps(
        ["end", "hall", "hall", "end", "end", "hall", "hall"],
        ["travel", "travel", "travel", "around", "travel", "around"],
    )
    solution = solve(corridor)
    assert solution.count > 1
    found = route(solution, 0, 3)
    assert (found.agree, found.maps) == (tuple(range(1, solution.count + 1)), solution.count)
    assert f"{solution.count} of {solution.count} maps" in found.sentence
    # From the step at which the next experiment distinguishes the rivals, only maps like this one
    # expect the same views.
    odd = [
        route(solution, None, goal, map=m + 1)
        for m in range(solution.count)
        for goal in {x for s, _, x in solution.maps[m].links if s == solution.maps[m].labels[-1]}
    ]
    assert any(len(way.agree) < solution.count for way in odd)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            {"start": 99, "goal": 1},
            "from: expected a dstate, 0 to 7, or a place as p0, or a path as path0, or a region as "
            "region0, got 99",
        ),
        ({"start": 0, "goal": "p9"}, "to: expected a dstate, 0 to 7, or a place as p0"),
        ({"start": 0, "goal": True}, "to: expected a dstate"),
        ({"start": 0, "goal": 1, "avoid": ["x"]}, r"avoid\[0\]: expected a dstate"),
        ({"start": 0, "goal": 1, "by": "hours"}, "by: expected actions, places or metres"),
        ({"start": 0, "goal": 1, "map": 7}, "expected the number of a map, 1 to 1"),
        (
            {"start": 0, "goal": 1, "by": "metres"},
            "by: expected actions or places, got metres: the map has no poses",
        ),
    ],
)
def test_route_errors_name_the_range(arguments: dict[str, object], message: str) -> None:
    with pytest.raises(MapError, match=message):
        route(solve(rectangle(8)).maps[0], **arguments)  # type: ignore[arg-type]


def test_bare_number_is_refused_where_it_is_ambiguous(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Pictures number places, and the tables dstates and steps."""
    file = str(tmp_path / "maps.json")
    solve(replace(rectangle(8), name="round")).save(file)
    for words in (
        ["route", file, "--to", "3"],
        ["route", file, "--from", "3", "--to", "p1"],
        ["route", file, "--to", "p1", "--avoid", "3"],
        ["name", file, "3", "kitchen"],
        ["correct", file, "--elsewhere", "3,p1"],
        ["correct", file, "--open", "3 north"],
    ):
        assert main(words) == 1, words
        assert "write p3, d3 or round:3" in capsys.readouterr().err, words
    assert main(["name", file, "d3", "kitchen"]) == 0
    assert capsys.readouterr().out.startswith("place 1, the place of round:3, is 'kitchen'")
    assert main(["route", file, "--to", "KITCHN"]) == 1
    assert "did you mean kitchen?" in capsys.readouterr().err
    assert main(["route", file, "--from", "D0", "--to", "P1"]) == 0
    assert "from dstate 0 at place 0 to place 1 (kitchen)" in capsys.readouterr().out
    file = str(tmp_path / "causal.json")
    solve(replace(rectangle(8), name="round"), Theory.causal()).save(file)
    assert main(["route", file, "--from", "0", "--to", "3"]) == 0


def test_route_by_places_needs_places() -> None:
    with pytest.raises(MapError, match="the map has no places"):
        route(solve(rectangle(8), Theory.causal()).maps[0], 0, 1, by="places")


def test_route_by_places_leads_back_without_paths() -> None:
    """Maps of logs have no paths. The robot can drive back, although it never did."""
    moves = [(5, 0, 0)] * 3 + [(0, 0, 3.1416)]
    actions = ["travel", "travel", "travel", "around"]
    found = solve(Trace.from_steps("abcde", actions, displacements=moves), BARE)
    with pytest.raises(MapError, match="take --by places"):
        route(found, None, "p1", by="actions")
    back = route(found, None, "p1", by="places")
    assert route(found, None, "p1") == back  # falls back, as nothing leaves the last dstate
    assert (back.actions, back.places) == (("travel", "travel"), (3, 2, 1))
    assert (back.views, back.is_known) == (("e", None, None), False)
    assert route(found, "p0", "p3", by="places").is_known


def test_renumbered_map_keeps_its_poses(square: SSHMap) -> None:
    assert square.renumbered().fit == square.fit
    turned = SSHMap(
        (1, 0),
        (DState(0, "a"), DState(1, "b")),
        (),
        fit=Fit(0.0, 1, 1.0, poses=(Pose(1.0, 2.0, 3.0), Pose(0.0, 0.0, 0.0))),
    )
    found = turned.renumbered().fit
    assert found is not None
    assert found.poses == (Pose(0.0, 0.0, 0.0), Pose(1.0, 2.0, 3.0))


def test_route_command_prints_the_result_of_python(
    square: SSHMap, tmp_path: object, capsys: pytest.CaptureFixture[str]
) -> None:
    file = f"{tmp_path}/map.json"
    square.save(file)
    assert main(["route", file, "--from", "d0", "--to", "p2", "--by", "metres", "--json"]) == 0
    printed = capsys.readouterr().out
    assert json.loads(printed) == json.loads(
        json.dumps(route(square, 0, "p2", by="metres").to_dict())
    )
    assert main(["route", file, "--to", "p1", "--by", "places", "--avoid", "p2,p3"]) == 0
    told = capsys.readouterr().out
    assert "never tried" not in told or "implied" in told
    assert main(["route", file, "--to", "d44"]) == 1
    assert "0 to" in capsys.readouterr().err


def maze(seed: int, side: int = 4, steps: int = 150) -> SSHMap:
    """The true map of a random walk through a maze without loops, with its regions."""
    chance = random.Random(seed)
    doors: set[frozenset[tuple[int, int]]] = set()
    reached, waiting = {(0, 0)}, [(0, 0)]
    while waiting:
        x, y = waiting[-1]
        near = [(x + 1, y), (x - 1, y), (x, y + 1), (x, y - 1)]
        new = [p for p in near if p not in reached and min(p) >= 0 and max(p) < side]
        if not new:
            waiting.pop()
            continue
        doors.add(frozenset(((x, y), there := chance.choice(new))))
        reached.add(there)
        waiting.append(there)
    ways = ((0, 1), (1, 0), (0, -1), (-1, 0))

    def ahead(at: tuple[int, int], way: int) -> tuple[int, int] | None:
        there = (at[0] + ways[way][0], at[1] + ways[way][1])
        return there if frozenset((at, there)) in doors else None

    def first_of(at: tuple[int, int], way: int) -> tuple[int, int]:
        """The place where the street in this way, or against it, begins."""
        while (there := ahead(at, way % 2 + 2)) is not None:
            at = there
        return at

    faced = [((0, 0), 0)]
    actions = []
    for _ in range(steps):
        at, way = faced[-1]
        there = ahead(at, way)
        action = chance.choice(["travel"] * 3 * (there is not None) + ["right", "left"])
        actions.append(action)
        turn = {"right": 1, "left": 3}.get(action, 0)
        faced.append((there or at, way) if action == "travel" else (at, (way + turn) % 4))
    states = list(dict.fromkeys(faced))
    places = list(dict.fromkeys(at for at, _ in states))
    street = {(at, way): (first_of(at, way), way % 2) for at, way in states}
    is_street = {s for s in states if ahead(*s) or ahead(s[0], (s[1] + 2) % 4)}
    streets = list(dict.fromkeys(street[s] for s in states if s in is_street))
    dstates = tuple(
        DState(
            i,
            f"{at} {way}",
            places.index(at),
            streets.index(street[at, way]) if (at, way) in is_street else None,
            (1 if way < 2 else -1) if (at, way) in is_street else None,
        )
        for i, (at, way) in enumerate(states)
    )
    paths = tuple(
        MapPath(
            i, tuple(places.index(at) for at in sorted({s[0] for s in is_street if street[s] == h}))
        )
        for i, h in enumerate(streets)
    )
    labels = tuple(states.index(s) for s in faced)
    links = {(labels[i], action, labels[i + 1]) for i, action in enumerate(actions)}
    found = SSHMap(labels, dstates, tuple(sorted(links)), tuple(range(len(places))), paths)
    trace = Trace.from_steps([f"{at} {way}" for at, way in faced], actions)
    return with_regions(found.renumbered(), trace)


@pytest.mark.slow
def test_route_by_regions_agrees_with_the_plain_route() -> None:
    ssh_map = maze(2)
    assert ssh_map.regions
    told = 0
    for start, goal in product(ssh_map.places, repeat=2):
        for by in ("places", "actions"):
            try:
                plain = route(replace(ssh_map, regions=None), f"p{start}", f"p{goal}", by=by)
            except MapError:
                with pytest.raises(MapError):
                    route(ssh_map, f"p{start}", f"p{goal}", by=by)
                continue
            found = route(ssh_map, f"p{start}", f"p{goal}", by=by)
            assert plain.legs == ()
            # Regions make no route longer. Each route goes through the doors in order.
            assert found.moves == plain.moves
            doors = [leg.door for leg in found.legs if leg.door is not None]
            places = iter(place for place, _ in groupby(found.places))
            assert all(door in places for door, _ in groupby(doors))
            told += len(found.legs)
    assert told


def test_route_to_a_region_ends_at_its_nearest_place() -> None:
    ssh_map = maze(2)
    assert ssh_map.regions
    named = replace(ssh_map, names=(Name("region", 1, "west wing"),))
    inside = named.regions[1].places if named.regions else ()
    for start in named.places:
        lengths = [len(route(named, f"p{start}", f"p{goal}").moves) for goal in inside]
        found = route(named, f"p{start}", "west wing")
        assert found == route(named, f"p{start}", "region1")
        assert found.places[-1] in inside
        assert len(found.moves) == min(lengths)
    assert "is in region 1 (west wing)" in route(named, f"p{inside[0]}", "west wing").sentence
    with pytest.raises(MapError, match="or a region as region0, or west wing, got 'region99'"):
        route(named, 0, "region99")


def test_route_prints_regions_first(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    solve(written("a T b R c T d L e T f")).save(tmp_path / "maps.json")
    ends = ["--from", "p0", "--to", "p3", "--by", "places"]
    assert main(["route", str(tmp_path / "maps.json"), *ends]) == 0
    assert capsys.readouterr().out.splitlines()[1] == (
        "by regions: leave region 0 through place 1; pass from right to left of path 1+; "
        "enter region 3 through place 2"
    )
    assert main(["route", str(tmp_path / "maps.json"), *ends, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["legs"] == [
        {"move": "leave", "region": 0, "door": 1},
        {"move": "pass", "path": 1, "starts": "right"},
        {"move": "enter", "region": 3, "door": 2},
    ]
