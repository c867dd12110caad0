"""Traces: reading, writing, and every kind of malformed file."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ssh_abduction import Trace
from ssh_abduction.data import Action, Step, TraceError
from ssh_abduction.data.odometry import Odometry
from ssh_abduction.data.trace import LONGEST_LINE

HEADER = '{"format": "ssh-trace", "version": 1}'
STEP = '{"view": "a", "action": "travel"}'
LAST = '{"view": "b"}'


def written(folder: Path, *lines: str) -> Path:
    path = folder / "trace.jsonl"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def test_trace_survives_a_round_trip(tmp_path: Path) -> None:
    lines = [
        '{"format": "ssh-trace", "version": 1, "name": "n", "images": "i.npz",'
        ' "robot": {"wheels": 4}}',
        '{"view": "ä", "image": [1.5, 2], "action": {"name": "go", "kind": "travel", "speed": 1},'
        ' "star": [0, 90.5], "battery": 0.5}',
        '{"view": 7, "action": {"name": "spin", "kind": "turn", "turn": "left"},'
        ' "displacement": [1, 0, -0.5], "truth": {"place": "x"}}',
        '{"view": "v", "action": "look", "image": 3}',
        '{"image": 4, "note": null}',
    ]
    path = written(tmp_path, *lines)
    trace = Trace.load(path)
    assert [json.loads(line) for line in trace.to_lines()] == [json.loads(line) for line in lines]
    copy = tmp_path / "copy.jsonl"
    trace.save(copy)
    assert Trace.load(copy) == trace
    assert [p.name for p in tmp_path.iterdir()].count("copy.jsonl") == 1
    assert len(list(tmp_path.iterdir())) == 2  # no draft is left behind


def test_standard_actions_are_plain_words() -> None:
    trace = Trace.from_steps("abcde", ["travel", "right", "left", "around"])
    assert [(a.kind, a.turn) for a in trace.actions] == [
        ("travel", None),
        ("turn", "right"),
        ("turn", "left"),
        ("turn", "around"),
    ]
    assert [step.to_json().get("action") for step in trace.steps] == [
        "travel",
        "right",
        "left",
        "around",
        None,
    ]


def test_fields_may_come_in_any_order(tmp_path: Path) -> None:
    there = Trace.load(
        written(tmp_path, HEADER, '{"view": "a", "star": [1, 0, 0, 0], "action": "travel"}', LAST)
    )
    back = Trace.load(
        written(
            tmp_path,
            '{"version": 1, "format": "ssh-trace"}',
            '{"action": "travel", "star": [1, 0, 0, 0], "view": "a"}',
            LAST,
        )
    )
    assert there == back


@pytest.mark.parametrize(
    ("star", "openings"),
    [
        ((1, 0, 0, 1), (True, False, False, True)),
        ((0.0, 90.0), (True, True, False, False)),
        ((-90.0, 170.0, 20.0), (True, False, True, True)),
        ((), (False, False, False, False)),
        (None, None),
    ],
)
def test_openings_of_a_star_at_right_angles(
    star: tuple[float, ...] | None, openings: tuple[bool, ...] | None
) -> None:
    assert Step(view="a", star=star).openings == openings


def test_bearings_in_one_quarter_are_refused() -> None:
    with pytest.raises(TraceError, match="merge the openings"):
        _ = Step(view="a", star=(0, 30)).openings


BAD: dict[str, tuple[list[str], str]] = {
    "no header": ([STEP, LAST], "1: format: expected"),
    "wrong format": (['{"format": "csv", "version": 1}', LAST], "1: format: expected"),
    "wrong version": (
        ['{"format": "ssh-trace", "version": 2}', LAST],
        "1: version: expected 1, got 2",
    ),
    "no version": (['{"format": "ssh-trace"}', LAST], "1: version: expected 1, got None"),
    "header of another type": (["[1, 2]", LAST], "1: line: expected a JSON object"),
    "header alone": ([HEADER], " expected at least one step"),
    "name that is no text": (
        ['{"format": "ssh-trace", "version": 1, "name": 3}', LAST],
        "1: name: expected a text",
    ),
    "NaN": (
        [HEADER, '{"view": "a", "displacement": [NaN, 0, 0]}'],
        "2: displacement[0]: expected a finite number, got NaN",
    ),
    "infinite range": (
        [HEADER, '{"image": [1, Infinity]}'],
        "2: image[1]: expected a finite number, got Infinity",
    ),
    "number that overflows": (
        [HEADER, '{"image": [1, 1e999]}'],
        "2: image[1]: expected a finite number",
    ),
    "number of a million digits": (
        [HEADER, '{"view": ' + "1" * 10**6 + "}"],
        "2: line: expected JSON, got a number",
    ),
    "no view": ([HEADER, '{"action": "travel"}', LAST], "2: view: expected"),
    "view of another type": (
        [HEADER, '{"view": 1.5}'],
        "2: view: expected a text or an integer, got 1.5",
    ),
    "true as a view": (
        [HEADER, '{"view": true}'],
        "2: view: expected a text or an integer, got True",
    ),
    "view of 40 bits": (
        [HEADER, '{"view": 1000000000000}'],
        "2: view: expected an integer of 32 bits",
    ),
    "view with a null character": (
        [HEADER, '{"view": "a\\u0000"}'],
        "2: view: expected a text without null",
    ),
    "last step with an action": ([HEADER, STEP], "2: action: expected none on the last step"),
    "missing action": ([HEADER, LAST, LAST], "2: action: expected one"),
    "action of another type": (
        [HEADER, '{"view": "a", "action": 3}', LAST],
        "2: action: expected a name",
    ),
    "action without a name": (
        [HEADER, '{"view": "a", "action": {"kind": "travel"}}', LAST],
        "2: action.name: expected a text",
    ),
    "unknown kind": (
        [HEADER, '{"view": "a", "action": {"name": "j", "kind": "jump"}}', LAST],
        "2: action.kind: expected",
    ),
    "unknown turn": (
        [HEADER, '{"view": "a", "action": {"name": "u", "kind": "turn", "turn": "up"}}', LAST],
        "2: action.turn: expected",
    ),
    "turn without a side": (
        [HEADER, '{"view": "a", "action": {"name": "u", "kind": "turn"}}', LAST],
        "2: action.turn: expected",
    ),
    "travel with a turn": (
        [HEADER, '{"view": "a", "action": {"name": "u", "kind": "travel", "turn": "left"}}', LAST],
        "2: action.kind: expected",
    ),
    "one name, two kinds": (
        [
            HEADER,
            '{"view": "a", "action": {"name": "go", "kind": "travel"}}',
            '{"view": "a", "action": "go"}',
            LAST,
        ],
        "3: action: 'go' has kind None",
    ),
    "star of texts": (
        [HEADER, '{"view": "a", "star": ["n"]}'],
        "2: star[0]: expected a finite number",
    ),
    "star with equal bearings": (
        [HEADER, '{"view": "a", "star": [10, 370]}'],
        "2: star: expected four 0/1",
    ),
    "displacement in millimetres": (
        [HEADER, '{"view": "a", "displacement": [5000, 0, 0]}'],
        "2: displacement: expected metres, at most 1,000",
    ),
    "displacement in degrees": (
        [HEADER, '{"view": "a", "displacement": [5, 0, 90]}'],
        "2: displacement[2]: expected radians",
    ),
    "covariance without displacement": (
        [HEADER, '{"view": "a", "covariance": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}'],
        "2: covariance: expected a displacement",
    ),
    "covariance too small": (
        [
            HEADER,
            '{"view": "a", "displacement": [1, 0, 0], "covariance": '
            "[[1e-300, 0, 0], [0, 1, 0], [0, 0, 1]]}",
        ],
        "2: covariance: expected variances from 1e-16 to 1e+16",
    ),
    "covariance not positive": (
        [
            HEADER,
            '{"view": "a", "displacement": [1, 0, 0], "covariance": '
            "[[1, 2, 0], [2, 1, 0], [0, 0, 1]]}",
        ],
        "2: covariance: expected a positive definite matrix",
    ),
    "covariance not symmetric": (
        [
            HEADER,
            '{"view": "a", "displacement": [1, 0, 0], "covariance": '
            "[[1, 0.5, 0], [0, 1, 0], [0, 0, 1]]}",
        ],
        "2: covariance: expected a symmetric matrix",
    ),
    "covariance of two rows": (
        [HEADER, '{"view": "a", "displacement": [1, 0, 0], "covariance": [[1, 0, 0], [0, 1, 0]]}'],
        "2: covariance: expected three rows",
    ),
    "covariance with a text": (
        [
            HEADER,
            '{"view": "a", "displacement": [1, 0, 0], "covariance": '
            '[[1, 0, 0], [0, "x", 0], [0, 0, 1]]}',
        ],
        "2: covariance[1][1]: expected a finite number",
    ),
    "odometry no object": (
        ['{"format": "ssh-trace", "version": 1, "odometry": 3}'],
        "1: odometry: expected an object",
    ),
    "odometry negative": (
        ['{"format": "ssh-trace", "version": 1, "odometry": {"along": -1}}'],
        "1: odometry.along: expected a number from 0",
    ),
    "displacement of two": (
        [HEADER, '{"view": "a", "displacement": [1, 2]}'],
        "2: displacement: expected [dx, dy, dtheta]",
    ),
    "negative index": ([HEADER, '{"image": -1}'], "2: image: expected an index"),
    "broken JSON": (
        [HEADER, STEP, '{"view": "b"'],
        "3: line: expected JSON, got broken JSON at column 13",
    ),
    "two objects on a line": (
        [HEADER, LAST + LAST],
        "2: line: expected JSON, got broken JSON",
    ),
    "a field twice": (
        [HEADER, '{"view": "a", "view": "b"}'],
        "2: line: expected JSON, got the field 'view' twice",
    ),
    "empty line inside": ([HEADER, STEP, "", LAST], "3: line: expected a step, got an empty line"),
    "a number on a line": ([HEADER, "5"], "2: line: expected a JSON object in braces, got 5"),
    "NaN in the truth": (
        [HEADER, '{"view": "a", "truth": {"pose": [1, [2, -Infinity]]}}'],
        "2: truth.pose[1][1]: expected a finite number, got -Inf",
    ),
    "half a character": (
        [HEADER, '{"view": "a\\ud800"}'],
        "2: line: expected text, got half a character, \\ud800",
    ),
    "nested too deeply": (
        [HEADER, '{"view": "a", "x": ' + "[" * 10**5 + "]" * 10**5 + "}"],
        "2: line: expected JSON, got one nested",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_malformed_trace_error_names_line_field_and_remedy(case: str, tmp_path: Path) -> None:
    lines, message = BAD[case]
    path = written(tmp_path, *lines)
    with pytest.raises(TraceError) as error:
        Trace.load(path)
    text = str(error.value)
    assert text.startswith(f"{path}:{message}")
    assert "\n" not in text
    assert len(text) < len(str(path)) + 300
    assert ";" in text or "(" in text  # how to mend it


def test_broken_json_error_names_the_line(tmp_path: Path) -> None:
    path = written(tmp_path, HEADER, *[STEP] * 4709, '{"view": "a", "action": travel}', LAST)
    with pytest.raises(
        TraceError,
        match=r"trace\.jsonl:4711: line: expected JSON, got broken JSON at column 25",
    ):
        Trace.load(path)


def test_empty_trace_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "t").write_bytes(b"")
    with pytest.raises(TraceError, match=r"1: header: expected .* got an empty file"):
        Trace.load(tmp_path / "t")


@pytest.mark.parametrize(
    "content", [bytes(range(256)), f"{HEADER}\n".encode() + b'{"view": "\xe9"}']
)
def test_binary_trace_file_is_refused(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "t").write_bytes(content)
    with pytest.raises(TraceError, match="is this a binary file"):
        Trace.load(tmp_path / "t")


def test_folder_and_missing_file_are_refused_as_traces(tmp_path: Path) -> None:
    with pytest.raises(TraceError, match="Is a directory; check the path"):
        Trace.load(tmp_path)
    with pytest.raises(TraceError, match="No such file or directory; check the path"):
        Trace.load(tmp_path / "nothing")


def test_endless_line_is_not_read_into_memory(tmp_path: Path) -> None:
    """A sparse file of 1 GB stands for a line of that length."""
    path = tmp_path / "t"
    with path.open("wb") as file:
        file.write(HEADER.encode() + b"\n")
        file.truncate(2**30)
    with pytest.raises(TraceError, match=":2: line: expected at most 16 MiB"):
        Trace.load(path)
    assert LONGEST_LINE == 16 * 2**20


def test_trace_with_a_byte_order_mark_is_read(tmp_path: Path) -> None:
    path = tmp_path / "t"
    path.write_text("\ufeff" + HEADER + "\r\n" + LAST + "\r\n\r\n", encoding="utf-8")
    assert Trace.load(path).views == ("b",)


def test_saving_into_a_missing_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(TraceError, match="cannot write the trace"):
        Trace.from_steps(["a"], []).save(tmp_path / "no" / "t.jsonl")


@pytest.mark.parametrize(
    ("views", "actions", "message"),
    [
        (["a"], ["travel"], "expected one view more than actions, got 1 views and 1 actions"),
        ([], [], "expected one view more than actions"),
        ([1.5], [], "step 0: view: expected a text or an integer"),
        (["a", "b"], [7], "action: expected a name"),
    ],
)
def test_from_steps_refuses_wrong_steps(views: list[str], actions: list[str], message: str) -> None:
    with pytest.raises(TraceError, match=message):
        Trace.from_steps(views, actions)


def test_views_may_be_numpy_integers() -> None:
    """Clusterings return such integers."""
    trace = Trace.from_steps(np.array([3, 0, 3]), ["travel", "travel"])
    assert trace == Trace.from_steps([3, 0, 3], ["travel", "travel"])
    assert all(type(step.view) is int for step in trace)
    with pytest.raises(TraceError, match="expected a text or an integer"):
        Trace.from_steps(np.array([True, False]), ["travel"])


def test_prefix_ends_without_an_action() -> None:
    trace = Trace.from_steps("abc", ["travel", "right"], name="n")
    assert trace.prefix(2) == Trace.from_steps("ab", ["travel"], name="n")
    assert trace.prefix(3) == trace


@settings(max_examples=15)
@given(
    st.binary(max_size=200)
    | st.binary(max_size=50).map(lambda line: f"{HEADER}\n".encode() + line)
    | st.text(max_size=200).map(lambda text: f"{HEADER}\n{text}".encode())
)
def test_any_bytes_are_a_trace_or_a_clear_error(data: bytes) -> None:
    import tempfile

    with tempfile.NamedTemporaryFile() as file:
        file.write(data)
        file.flush()
        message = ""
        try:
            Trace.load(file.name)
        except TraceError as error:
            message = str(error)
        assert not message or message.startswith(file.name)
        assert "\n" not in message


def test_traces_are_hashable() -> None:
    traces = [Trace.from_steps("ab", ["travel"], name="n") for _ in range(2)]
    assert len(set(traces)) == 1
    truthful = Step(view="a", truth={"place": [1]}, extra={"x": []})
    assert hash(truthful) == hash(Step(view="a"))


@pytest.mark.parametrize(
    ("name", "kind", "turn"),
    [
        ("spin", "turn", None),
        ("x", "hop", None),
        ("x", "travel", "right"),
        (5, "travel", None),
        ("", None, None),
        ("x", None, "left"),
    ],
)
def test_malformed_actions_are_refused(name: str, kind: str, turn: str) -> None:
    with pytest.raises(TraceError, match=r"^action\.(name|kind|turn): expected"):
        Action(name, kind, turn)  # type: ignore[arg-type]


@pytest.mark.parametrize("view", [1.5, True, 2**40, "a\0"])
def test_malformed_steps_are_refused(view: str) -> None:
    with pytest.raises(TraceError, match=r"^view: expected"):
        Step(view=view)


def test_save_refuses_values_that_json_cannot_hold(tmp_path: Path) -> None:
    with pytest.raises(TraceError, match="expected values that JSON can hold"):
        Trace((Step(view="a", truth=float("inf")),)).save(tmp_path / "t.jsonl")
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(TraceError):
        Trace.load("a\0b")


def test_actions_print_and_compare() -> None:
    assert Action.of("travel") == Action("travel", "travel")
    assert Action.of({"name": "left", "kind": "turn"}).turn == "left"
    assert Action.of(Action("x")) == Action("x")


def test_displacements_and_odometry_survive_a_round_trip(tmp_path: Path) -> None:
    noise = [[0.5, 0.1, 0.0], [0.1, 0.2, 0.0], [0.0, 0.0, 0.01]]
    trace = Trace.from_steps(
        "aab",
        ["travel", "right"],
        displacements=[(10, 0.5, 0.1), None],
        covariances=[noise, None],
        odometry={"along": 0.1, "colour": "red"},
    )
    trace.save(tmp_path / "t.jsonl")
    again = Trace.load(tmp_path / "t.jsonl")
    assert again == trace
    assert again.steps[1].displacement == (10.0, 0.5, 0.1)
    assert again.covariance(1) == tuple(map(tuple, noise))
    assert again.covariance(2) is None
    assert again.odometry is not None
    assert (again.odometry.along, again.odometry.across) == (0.1, 0.02)
    assert again.odometry.to_json()["colour"] == "red"
    assert '"odometry"' not in "".join(trace.without_displacements().to_lines())


def test_covariance_is_turned_to_the_direction_of_a_step() -> None:
    odometry = Odometry(along=0.1, across=0.01, heading=0.01, turning=0.1, position=0.0, angle=0.0)
    (xx, xy, _), (_, yy, _), (_, _, heading) = odometry.covariance(
        (0.0, 10.0, math.pi / 2)
    )  # to the left
    assert (xx, xy, yy) == pytest.approx((0.01, 0.0, 1.0), abs=1e-5)
    assert heading == pytest.approx(0.01 + (0.1 * math.pi / 2) ** 2, abs=1e-5)
    (xx, xy, _), _, _ = odometry.covariance(
        (6.0, 8.0, 0.0)
    )  # along and across are turned to the way
    assert xx == pytest.approx(0.6**2 * 1.0 + 0.8**2 * 0.01, abs=1e-5)
    assert xy == pytest.approx((1.0 - 0.01) * 0.6 * 0.8, abs=1e-5)
