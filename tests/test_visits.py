"""Maps are judged by poses and relative poses, and the pairs are also counted naively."""

from __future__ import annotations

import json
import math
import random
import re
from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations, pairwise
from pathlib import Path

import pytest
from test_evaluate import labelled

from ssh_abduction import Trace
from ssh_abduction.cli import main
from ssh_abduction.data import TraceError
from ssh_abduction.data.odometry import Pose, displacement_between
from ssh_abduction.evaluation import evaluate_visits
from ssh_abduction.evaluation.trajectory import Relation, Relations

FREIBURG = Path(__file__).parent.parent.parent / "shared" / "data" / "logs"


def posed(poses: Sequence[object], kinds: Sequence[str], times: Sequence[float] = ()) -> Trace:
    """A trace with these true poses, with a `travel` or a `turn` after each step but the last."""
    named = {"travel": "travel", "turn": "right"}
    seen = Trace.from_steps("v" * len(poses), [named[kind] for kind in kinds])
    extras = [{"time": time} for time in times] or [{}] * len(poses)
    return replace(
        seen,
        steps=tuple(
            replace(step, truth={"pose": pose}, extra=extra)
            for step, pose, extra in zip(seen.steps, poses, extras, strict=True)
        ),
    )


@pytest.mark.parametrize("seed", range(20))
def test_pairs_of_visits_equal_naive_counts(seed: int) -> None:
    rng = random.Random(seed)
    kinds = [rng.choice(["travel", "travel", "turn"]) for _ in range(11)]
    poses: list[list[float] | None] = []
    for t in range(12):
        moved = t == 0 or kinds[t - 1] == "travel" or poses[-1] is None
        where = [rng.uniform(0, 5), 0] if moved else poses[-1][:2]  # type: ignore[index]
        poses.append(None if rng.random() < 0.15 else [*where, rng.choice([0, math.pi / 2])])
    poses[0] = [0, 0, 0]
    labels = [*(rng.randrange(5) for _ in range(11)), 4]
    place = [rng.randrange(2) for _ in range(4)] + [None]
    found = evaluate_visits([labelled(labels, place)], posed(poses, kinds))

    visits = [[0]]
    for t, kind in enumerate(kinds, 1):
        if kind == "travel":
            visits.append([])
        visits[-1].append(t)
    at = [next((poses[t] for t in visit if poses[t]), None) for visit in visits]

    def is_near(a: list[float] | None, b: list[float] | None) -> bool | None:
        return None if a is None or b is None else math.dist(a[:2], b[:2]) <= 2

    counts = dict.fromkeys(("judged", "returns", "stayed", "unknown", "joined", "right"), 0)
    steps = dict(counts)

    def add(to: dict[str, int], near: bool | None, left: bool, one: bool, joined: bool) -> None:
        if near is None:
            to["unknown"] += 1
        elif near and not left:
            to["stayed"] += 1
        else:
            to["judged"] += 1
            to["returns"] += near and one
            to["joined"] += joined
            to["right"] += near and one and joined

    for v, w in combinations(range(len(visits)), 2):
        left = any(is_near(at[v], at[u]) is False for u in range(v + 1, w))
        own = {place[labels[t]] for t in visits[v]} & {place[labels[t]] for t in visits[w]}
        add(counts, is_near(at[v], at[w]), left, True, bool(own - {None}))
        for i in visits[v]:
            for j in visits[w]:
                facing = (
                    poses[i] is not None and poses[j] is not None and poses[i][2] == poses[j][2]
                )  # type: ignore[index]
                add(steps, is_near(poses[i], poses[j]), left, facing, labels[i] == labels[j])
    for pairs, map_pairs, naive in (
        (found.places, found.maps[0].places, counts),
        (found.dstates, found.maps[0].dstates, steps),
    ):
        assert [pairs.judged, pairs.returns, pairs.stayed, pairs.unknown] == [
            naive[k] for k in ("judged", "returns", "stayed", "unknown")
        ]
        assert map_pairs is not None
        assert (map_pairs.joined, map_pairs.right) == (naive["joined"], naive["right"])


def test_turns_and_next_places_are_no_returns() -> None:
    trace = posed(
        [[0, 0, 0], [0, 0, 1.6], [1.5, 0, 0], [9, 0, 0], [1, 0, 3.1]],
        ["turn", "travel", "travel", "travel"],
    )
    found = evaluate_visits([labelled([0, 1, 2, 3, 4], [0, 0, 0, 1, 0])], trace)
    assert (found.visits, found.places.judged, found.places.returns, found.places.stayed) == (
        4,
        5,
        2,
        1,
    )
    assert found.maps[0].places is not None
    assert (found.maps[0].places.precision, found.maps[0].places.recall) == (1, 1)
    assert (found.dstates.returns, found.maps[0].dstates.recall) == (
        0,
        None,
    )  # the last step faces back
    causal = evaluate_visits([labelled([0] * 5, [None])], trace).maps[0]
    assert causal.places is None
    assert (causal.dstates.joined, causal.dstates.right) == (7, 0)


def circle(turns: int) -> tuple[list[Pose], list[Relation]]:
    """Poses once a second on a circle of 20 m, the relations from each to the next, and one that
    closes it after each turn."""
    poses = [
        (20 * math.sin(a), 20 * (1 - math.cos(a)), a)
        for a in (math.radians(3 * t) for t in range(120 * turns + 1))
    ]
    pairs = [*pairwise(range(len(poses))), *((t, t + 120) for t in range(0, len(poses) - 120, 120))]
    return poses, [
        Relation(float(i), float(j), displacement_between(poses[i], poses[j])) for i, j in pairs
    ]


def test_relations_are_composed_along_the_shortest_chain() -> None:
    poses, related = circle(2)
    times = [0.0, 30.25, 120.0, 235.0, 260.0]
    seen = Relations(related).between(times, 1)
    assert seen[1] == ((0.0, 0.0, 0.0), 0.0)
    for time, told in zip(times[2:4], seen[2:4], strict=True):
        assert told is not None
        pose, way = told
        start = (
            20 * math.sin(math.radians(90.75)),
            20 * (1 - math.cos(math.radians(90.75))),
            math.radians(90.75),
        )
        assert pose == pytest.approx(displacement_between(start, poses[int(time)]), abs=0.01)
        # The chain goes over the relation that closes the circle. The robot drove up to 215 m.
        assert way < 60
    assert seen[4] is None  # long after the last time


def test_relations_judge_visits_without_poses(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _, related = circle(2)
    (tmp_path / "relations").write_text(
        "# seconds, metres, radians\n"
        + "".join(
            f"{r.first} {r.second} {r.displacement[0]} {r.displacement[1]} 0 0 0 "
            f"{r.displacement[2]}\n"
            for r in related
        )
    )
    trace = posed([None] * 5, ["travel"] * 4, [0, 60, 120, 182, 240])
    found = evaluate_visits(
        [labelled([0, 1, 0, 0, 1], [0, 1])], trace, relations=Relations.load(tmp_path / "relations")
    )
    assert (found.judge, found.places.judged, found.places.returns, found.places.unknown) == (
        "relations",
        9,
        3,
        1,
    )  # 2.1 m are in doubt
    assert found.maps[0].places is not None
    assert (found.maps[0].places.joined, found.maps[0].places.right) == (4, 1)
    # The robot saw the third place 30 m to its left: that is far from the first one.
    aside = replace(
        trace,
        steps=tuple(
            replace(step, extra={**step.extra, "seen": [0, 30 * (t == 2), 0]})
            for t, step in enumerate(trace.steps)
        ),
    )
    assert (
        evaluate_visits([], aside, relations=Relations.load(tmp_path / "relations")).places.returns
        == 1
    )
    trace.save(tmp_path / "trace.jsonl")
    labelled([0, 1, 0, 0, 1], [0, 1]).save(tmp_path / "map.json")
    arguments = [
        "evaluate",
        str(tmp_path / "map.json"),
        str(tmp_path / "trace.jsonl"),
        "--set",
        f"relations={tmp_path / 'relations'}",
    ]
    assert main([*arguments, "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"count": 1, "relations": found.to_dict()}
    assert main(arguments) == 0
    first, left_out, _, row = capsys.readouterr().out.splitlines()
    assert first.startswith(
        "judged by relations: 3 of 9 pairs of visits are returns to one place (within 2 m, and"
    )
    assert left_out == "left out: 1 pair, as relations do not tell how far apart they are"
    assert row.split()[:6] == ["1", "2", "4", "1", "0.250", "0.333"]


def test_relations_of_another_log_give_a_warning(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    poses, related = circle(2)
    times = [0, 60, 120, 180, 240]
    relations = Relations(related)
    own = posed([list(poses[t]) for t in times], ["travel"] * 4, times)
    assert evaluate_visits([], own, relations=relations).by_both == (10, 10)
    other = posed([[9 * t, 0, 0] for t in times], ["travel"] * 4, times)
    assert evaluate_visits([], other, relations=relations).by_both == (10, 6)
    other.save(tmp_path / "trace.jsonl")
    labelled(range(5), range(5)).save(tmp_path / "map.json")
    (tmp_path / "relations").write_text(
        "".join(
            f"{r.first} {r.second} {' '.join(map(str, r.displacement[:2]))} 0 0 0 "
            f"{r.displacement[2]}\n"
            for r in related
        )
    )
    files = [str(tmp_path / name) for name in ("map.json", "trace.jsonl")]
    assert main(["evaluate", *files, f"--set=relations={tmp_path / 'relations'}"]) == 0
    said = capsys.readouterr()
    assert (
        "relations and the poses of the trace agree on 6 of 10 pairs of visits only: are "
        in said.err
    )
    assert "poses and relations agree on 6 of 10 pairs of visits" in said.out


def test_evaluate_judges_names_and_poses(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    trace = posed([[0, 0, 0], [9, 0, 0], [1, 0, 0]], ["travel", "travel"])
    trace = replace(
        trace,
        steps=tuple(
            replace(step, truth={**step.truth, "place": "ABA"[t]})
            for t, step in enumerate(trace.steps)
        ),
    )
    trace.save(tmp_path / "trace.jsonl")
    labelled([0, 1, 0], [0, 1]).save(tmp_path / "map.json")
    arguments = ["evaluate", str(tmp_path / "map.json"), str(tmp_path / "trace.jsonl"), "--json"]
    told = [
        main(arguments) or json.loads(capsys.readouterr().out),
        main([*arguments, "--set", "near=0.5"]) or json.loads(capsys.readouterr().out),
    ]
    assert "poses" not in told[0]
    assert told[0]["maps"][0]["place_recall"] == 1
    assert {k: v for k, v in told[1].items() if k != "poses"} == told[0]
    assert (told[1]["poses"]["near"], told[1]["poses"]["places"]["returns"]) == (0.5, 0)
    text = (Path(__file__).parent.parent / "docs" / "reference" / "formats.md").read_text()
    names = [told[1]["poses"], told[1]["poses"]["places"], told[1]["poses"]["maps"][0]["places"]]
    assert all(f"`{name}`" in text for fields in names for name in fields)


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (
            "1 2 0.5 0 0 0 0",
            "relations:1: expected the numbers time1 time2 x y z roll pitch yaw, got '1 2 0.5 0 0 "
            "0 0'",
        ),
        ("# none\n\n1 2 x 0 0 0 0 0", "relations:3: expected the numbers"),
        ("1 2 nan 0 0 0 0 0", "relations:1: expected the numbers"),
        ("1 1 0.5 0 0 0 0 0", "relations:1: time2: expected another time than time1, got 1 twice"),
        ("# none", "relations: expected lines of time1 time2 x y z roll pitch yaw, got none"),
        ("\udcff", "relations: expected a text of relations, got another file"),
    ],
)
def test_malformed_relations_are_refused(lines: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "relations").write_bytes(lines.encode(errors="surrogateescape"))
    with pytest.raises(TraceError, match=f"{re.escape(message)}"):
        Relations.load(tmp_path / "relations")


def test_malformed_poses_and_times_are_refused() -> None:
    ssh_map = labelled([0, 1], [0, 1])
    with pytest.raises(
        TraceError,
        match=r"^step 1: truth.pose: expected \[x, y, heading\] in metres and radians, "
        r"got \[1, 2\]",
    ):
        evaluate_visits([ssh_map], posed([[0, 0, 0], [1, 2]], ["travel"]))
    with pytest.raises(
        TraceError, match=r"^trace: truth.pose: expected the true pose of some step, got none"
    ):
        evaluate_visits([ssh_map], posed([None, None], ["travel"]))
    with pytest.raises(TraceError, match=r"^near: expected a number above 0, got 0"):
        evaluate_visits([ssh_map], posed([[0, 0, 0]] * 2, ["travel"]), near=0)
    relations = Relations([Relation(1.0, 2.0, (1.0, 0.0, 0.0))])
    with pytest.raises(TraceError, match=r"^step 0: time: expected seconds, got 'noon'"):
        evaluate_visits([ssh_map], posed([None] * 2, ["travel"], ["noon", 1]), relations=relations)  # type: ignore[list-item]
    seen = posed([None] * 2, ["travel"], [1, 2])
    seen = replace(
        seen,
        steps=tuple(replace(step, extra={**step.extra, "seen": "there"}) for step in seen.steps),
    )
    with pytest.raises(
        TraceError,
        match=r"^step 0: seen: expected \[x, y, heading\] in metres and radians, got 'there'",
    ):
        evaluate_visits([ssh_map], seen, relations=relations)
    with pytest.raises(
        TraceError,
        match=r"^trace: time: expected steps between 1 and 2 s, as the relations have, got none",
    ):
        evaluate_visits([ssh_map], posed([None] * 2, ["travel"], [7, 8]), relations=relations)


@pytest.mark.skipif(not FREIBURG.exists(), reason="needs ../shared/data")
def test_relations_of_freiburg_agree_with_corrected_poses() -> None:
    lines = [line.split() for line in (FREIBURG / "fr079.log").read_text().splitlines()]
    poses = [tuple(map(float, line[2:5])) for line in lines if line[0] == "VERTEX2"][::12]
    times = [float(line[-3]) for line in lines if line[0] == "ROBOTLASER1"][::12]
    ssh_map = labelled(range(len(poses)), range(len(poses)))
    trace = posed([list(pose) for pose in poses], ["travel"] * (len(poses) - 1), times)
    nearer, near = (
        evaluate_visits([ssh_map], trace, near=metres).places.returns for metres in (1.5, 2)
    )
    by_relations = evaluate_visits(
        [ssh_map], trace, relations=Relations.load(FREIBURG / "fr079.relations")
    ).places
    assert by_relations.judged > 0.95 * len(poses) * (len(poses) - 1) / 2
    assert nearer < by_relations.returns < near  # pairs about 2 m apart are in doubt
