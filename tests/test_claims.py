"""Claims of a file of maps: true for all that `solve` prints, and each lie is named."""

from __future__ import annotations

import copy
import json
import random
from collections.abc import Callable
from itertools import product
from pathlib import Path
from typing import Any

import aces
import pytest
from aces import ACES
from worlds import TOURS, drive, rectangle

from ssh_abduction import SSHMap, Trace
from ssh_abduction.cli import main


def answer(trace: str, capsys: pytest.CaptureFixture[str], *words: str) -> dict[str, Any]:
    main(["solve", trace, "--json", *words])
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


def check(
    trace: str, data: dict[str, Any], folder: Path, capsys: pytest.CaptureFixture[str], *words: str
) -> tuple[int, str]:
    (folder / "maps.json").write_text(json.dumps(data))
    code = main(["check", "--bound", str(folder / "maps.json"), trace, *words])
    return code, capsys.readouterr().out


CHOICES = [
    "",
    "-n 2",
    "--time-limit 1e-9",
    "--time-limit 1e-9 --set without_speedups=greedy",
    "--theory circumscriptive",
    "--theory causal",
    "--set boundary=none --set path_order=partial --set prefer=paths,places,dstates",
    "--set boundary=defeasible",
    "--set boundary=defeasible --set prefer=dstates,excuses",
    "--set prefer=places",
    "--set prefer= -n 3",
    "--set without=on_path -n 3",
    "--set without=path_order_total,order_asymmetric --set prefer=paths -n 3",
]


@pytest.mark.parametrize(
    ("tour", "words"),
    [
        *product(["square"], CHOICES),
        ("comb", ""),
        ("comb", "-n 2"),
    ],
)
def test_check_accepts_the_claims_of_solve(
    tour: str, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = str(tmp_path / "trace.jsonl")
    drive(*TOURS[tour]).save(path)
    code, out = check(path, answer(path, capsys, *words.split()), tmp_path, capsys)
    assert code == 0, out


def test_check_accepts_an_unsatisfiable_answer(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = str(tmp_path / "trace.jsonl")
    Trace.from_steps("xyabcd", ["right", "travel", "travel", "around", "around"]).save(path)
    data = answer(path, capsys)
    assert data["status"] == "unsatisfiable"
    assert check(path, data, tmp_path, capsys)[0] == 0
    assert "complete: expected true" in check(path, data | {"complete": False}, tmp_path, capsys)[1]


LIES: dict[str, tuple[dict[str, Any] | Callable[[dict[str, Any]], Any], str]] = {
    "more maps than listed": ({"count": 5}, "count: expected 4, the number of maps listed, got 5"),
    "true is no number": (
        {"count": True},
        "count: expected 4, the number of maps listed, got True",
    ),
    "fewer maps than listed": (
        lambda d: d["maps"].pop(),
        "count: expected 3, the number of maps listed, got 4",
    ),
    "a map twice": (
        lambda d: d["maps"].append(d["maps"][1]),
        "maps: expected each map once, got maps 2 and 5, which are the same",
    ),
    "another trace": (
        {"steps": 22},
        "steps: expected 23, the number of steps of the trace, got 22",
    ),
    "a prefix longer than the trace": ({"prefix": 99}, "prefix: expected 0 to 23"),
    "a smaller cost": (
        lambda d: d["cost"].update(dstates=18),
        "cost: expected 19 dstates, 10 places, 4 paths, as map 1 has these, got 18 dstates",
    ),
    "a cost of what is not preferred": (
        lambda d: d["cost"].update(excuses=1),
        "cost: expected 19 dstates, 10 places, 4 paths, as map 1 has these",
    ),
    "no cost": (
        {"cost": None},
        "cost: expected 19 dstates, 10 places, 4 paths, as map 1 has these, got None",
    ),
    "a cost of another type": (
        {"cost": [19]},
        "cost: expected 19 dstates, 10 places, 4 paths, as map 1 has these, got [19]",
    ),
    "a bound above the cost": (
        {"bound": {"dstates": 20}},
        "bound: expected at most 19 dstates, as map 1 has no more, got 20",
    ),
    "a bound that is not proven": (
        lambda d: d["certificate"]["refuted"].pop(),
        "bound: expected at most 18 dstates, as the certificate proves no more, got 19",
    ),
    "optimal, and a bound below": (
        {"bound": {"dstates": 12}},
        "bound: expected 19 dstates, the cost of map 1, as the status is optimal, got 12",
    ),
    "optimal, and no bound": (
        {"bound": {}},
        "bound: expected 19 dstates, the cost of map 1, as the status is optimal, got none",
    ),
    "a bound of another type": (
        {"bound": {"dstates": "19"}},
        "bound: expected numbers of dstates, paths, places, excuses, got",
    ),
    "a bound of something else": (
        {"bound": {"rooms": 1}},
        "bound: expected numbers of dstates, paths, places, excuses, got",
    ),
    "a bound of what is not minimised first": (
        {"bound": {"dstates": 19, "paths": 1}},
        "bound: expected none of paths, as the theory minimises dstates first, got 1",
    ),
    "no such reason to stop": (
        {"complete": False, "stopped": "lunch"},
        "stopped: expected one of work limit, time limit, memory limit, interrupted, maps "
        "limit, no proof, got 'lunch'",
    ),
    "no such status": (
        {"status": "perfect"},
        "status: expected one of optimal, feasible, unsatisfiable, unknown, got 'perfect'",
    ),
    "a status of another type": (
        {"status": [1]},
        "status: expected one of optimal, feasible, unsatisfiable, unknown, got [1]",
    ),
    "no map, though there are some": (
        {"status": "unsatisfiable"},
        "status: expected optimal or feasible, as there is a map, got unsatisfiable",
    ),
    "without proof, though there are several": (
        {"status": "feasible"},
        "maps: expected one, as the status is feasible, got 4",
    ),
    "complete without proof": (
        {"status": "feasible"},
        "complete: expected false, as the status is feasible, got true",
    ),
    "complete, though stopped": (
        {"stopped": "maps limit"},
        "complete: expected false, as the search was stopped ('maps limit'), got true",
    ),
    "complete of another type": ({"complete": 1}, "complete: expected true or false, got 1"),
    "a false id": (lambda d: d["maps"][1].update(id="000000000000"), "maps[1].id: expected "),
    "an id of another type": (lambda d: d["maps"][1].update(id=7), "maps[1].id: expected "),
    "the id of another map": (
        lambda d: d["maps"][1].update(id=d["maps"][0]["id"]),
        "maps[1].id: expected ",
    ),
    "a false summary": (
        {"summary": "1 minimal map"},
        "summary: expected '4 minimal maps: the same dstates; ",
    ),
    "a summary of another type": (
        {"summary": [4]},
        "summary: expected '4 minimal maps: the same dstates; ",
    ),
    "a false backbone": (
        lambda d: d["backbone"]["places"].update(sometimes=[]),
        "backbone: expected the same dstates; ",
    ),
    "a fit without displacements": (
        lambda d: d["maps"][0].update(
            fit={"chi2": 1.0, "dof": 1, "p": 0.5, "scale": 0.0, "bend": 0.0}
        ),
        "maps[0].fit: expected none, as the trace has no displacements",
    ),
    "optimal without a map": (
        {"maps": []},
        "status: expected unsatisfiable or unknown, as there is no map, got optimal",
    ),
}


@pytest.mark.parametrize("case", LIES)
def test_check_names_each_false_claim(
    case: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    change, line = LIES[case]
    data = json.loads(aces.answer())
    if callable(change):
        change(data)
    else:
        data |= change
    code, out = check(ACES, data, tmp_path, capsys)
    assert code == 20
    assert any(shown.startswith(line) for shown in out.splitlines()), out


@pytest.mark.parametrize(
    ("lie", "said"),
    [
        ({}, None),
        ({"bound": {"cost": 4.0}}, "bound.cost: expected 4.5 dstates, the cost of map 1, as the"),
        ({"bound": {"cost": 4.6}}, "bound.cost: expected at most 4.5 dstates, as map 1 costs no m"),
        ({"bound": {"dstates": 3}}, "bound: expected a cost in dstates, got"),
        ({"cost": {"dstates": 3, "places": 0, "paths": 0}}, "faults, as map 1 has these, got 3 d"),
    ],
)
def test_check_bound_checks_the_costs_of_maps_with_faults(
    lie: dict[str, Any],
    said: str | None,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    path = str(tmp_path / "trace.jsonl")
    Trace.from_steps("abcabcabXabc", ["travel"] * 11).save(path)
    data = answer(path, capsys, "--theory", "causal", "--set", "misread=1.5")
    code, out = check(path, data | lie, tmp_path, capsys)
    assert code == (20 if said else 0), out
    assert (said or "the other claims of the file agree with its maps") in out
    assert "that no better map exists is not checked: a map may treat steps as wrong" in out


@pytest.mark.parametrize(
    ("views", "words", "why"),
    [
        (["a", None, "c", "a"], "", "a step whose view is unknown may be any dstate"),
        (["a", "b", "c", "a"], "--onto {maps}", "solve --onto writes no proof"),
        (["a", "b", "c", "a"], "--set without=functional_view", "axioms that are left out"),
    ],
)
def test_check_bound_says_what_it_cannot_check(
    views: list[str | None],
    words: str,
    why: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    first, path, maps = (str(tmp_path / name) for name in ("a.jsonl", "b.jsonl", "c.json"))
    Trace.from_steps("ab", ["right"], name="monday").save(first)
    Trace.from_steps(views, ["right"] * 3, name="tuesday").save(path)
    main(["solve", first, "-o", maps])
    assert main(["solve", path, *words.format(maps=maps).split(), "-o", maps]) == 0
    for lie, code in (({}, 0), ({"steps": 99}, 20)):
        data = json.loads(Path(maps).read_text())
        data |= lie
        Path(maps).write_text(json.dumps(data))
        capsys.readouterr()
        assert main(["check", "--bound", maps]) == code
        assert why in capsys.readouterr().out


def test_check_names_a_false_fit(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = str(tmp_path / "trace.jsonl")
    moves = [(10, 0.3, 0.1), (0.1, 0, 1.5)] * 4
    Trace.from_steps("abababab" + "a", ["travel", "left"] * 4, displacements=moves).save(path)
    data = answer(path, capsys, "--theory", "causal")
    assert check(path, data, tmp_path, capsys)[0] == 0
    fit, false = (
        data["maps"][0]["fit"],
        {"chi2": 0.0, "dof": 0, "p": 1.0, "scale": 0.5, "bend": -1.0},
    )
    for change in (
        *({"fit": fit | {part: value}} for part, value in false.items()),
        {"poses": [[0, 0, 0]] * len(data["maps"][0]["dstates"])},
    ):
        code, out = check(path, data | {"maps": [data["maps"][0] | change]}, tmp_path, capsys)
        assert code == 20
        assert f"maps[0].{next(iter(change))}: expected" in out


def test_check_names_maps_that_are_not_equally_good(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = str(tmp_path / "trace.jsonl")
    rectangle(24).save(path)
    data = answer(path, capsys, "--set", "boundary=none")
    worse = answer(path, capsys)["maps"][0]
    data["maps"].append(worse)
    data["count"] += 1
    code, out = check(path, data, tmp_path, capsys)
    assert code == 20
    assert (
        "maps: expected equal numbers of dstates, paths, places, as minimal maps have, got [4, "
        in out
    )


def test_check_recognises_a_renumbered_map(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = json.loads(aces.answer())
    rng = random.Random(0)
    for original in [SSHMap.from_dict(m) for m in data["maps"]]:
        assert original.renumbered() == original
        for _ in range(20):
            other = SSHMap.from_dict(_renamed(original.to_dict(), rng))
            assert other.renumbered() == original
            assert other.renumbered().paths == original.paths
    data["maps"][3] = _renamed(data["maps"][0], rng)
    code, out = check(ACES, data, tmp_path, capsys)
    assert code == 20
    assert (
        "maps: expected each map once, got maps 1 and 4, which are the same up to renaming\n" in out
    )


def _renamed(data: dict[str, Any], rng: random.Random) -> dict[str, Any]:
    """The same map with other numbers, and some paths reversed."""
    data = copy.deepcopy(data)
    dstate, place, path = (
        {x: i for i, x in enumerate(rng.sample(range(n), n))}
        for n in map(len, (data["dstates"], data["places"], data["paths"]))
    )
    flipped = {p["id"] for p in data["paths"] if rng.random() < 0.5}
    for s in data["dstates"]:
        if s["path"] in flipped:
            s["direction"] *= -1
        s["id"], s["place"], s["path"] = dstate[s["id"]], place.get(s["place"]), path.get(s["path"])
    data["dstates"].sort(key=lambda s: s["id"])
    data["labels"] = [dstate[s] for s in data["labels"]]
    data["links"] = [[dstate[s], action, dstate[x]] for s, action, x in data["links"]]
    for p in data["paths"]:
        order = [place[q] for q in p["order"]]
        p["id"], p["order"] = path[p["id"]], order[::-1] if p["id"] in flipped else order
    rng.shuffle(data["links"])
    return data
