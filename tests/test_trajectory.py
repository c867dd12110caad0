"""Trajectories in TUM format: truth for steps by their times, and messages if they do not fit."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path

import pytest

from ssh_abduction import SSHMap, Trace
from ssh_abduction.cli import main
from ssh_abduction.data import DState, TraceError
from ssh_abduction.data.trace import Action, Step
from ssh_abduction.evaluation import Trajectory, evaluate_visits, told_poses
from ssh_abduction.evaluation.trajectory import TrajectoryWarning

HEAD = "# timestamp tx ty tz qx qy qz qw\n"
# There and back along 20 m: steps 0 and 4 are at one place, and so are 1 and 3.
STOPS = (0.0, 10.0, 20.0, 10.0, 0.0)
TIMES = tuple(1000.0 + 20 * t for t in range(5))


def pose_line(time: float, x: float, y: float = 0.0, heading: float = 0.0) -> str:
    return f"{time} {x} {y} 0.1 0 0 {math.sin(heading / 2)} {math.cos(heading / 2)}\n"


def tum(shift: float = 0.0) -> str:
    """Poses twice a second, on the way between the stops."""
    text = HEAD
    for i in range(2 * 20 * 4 + 1):
        leg, share = divmod(i / 40, 1)
        ends = STOPS[int(leg)], STOPS[min(int(leg) + 1, 4)]
        text += pose_line(
            TIMES[0] + i / 2 + shift,
            ends[0] + share * (ends[1] - ends[0]),
            0,
            0.0 if leg < 2 else math.pi,
        )
    return text


def trace_at(
    times: tuple[float | None, ...] = TIMES, seen: tuple[float, float, float] | None = None
) -> Trace:
    extra = [
        ({} if time is None else {"time": time}) | ({} if seen is None else {"seen": list(seen)})
        for time in times
    ]
    go = Action("go", "travel")
    return Trace(
        tuple(
            Step(view="v", action=go if t < len(times) - 1 else None, extra=e)
            for t, e in enumerate(extra)
        )
    )


def there_and_back() -> SSHMap:
    return SSHMap((0, 1, 2, 1, 0), tuple(DState(i, "v", i) for i in range(3)), (), (0, 1, 2))


def read(folder: Path, text: str | bytes) -> Trajectory:
    (folder / "true.tum").write_bytes(text.encode() if isinstance(text, str) else text)
    return Trajectory.load(folder / "true.tum")


def evaluated(folder: Path, text: str, trace: Trace, *options: str) -> int:
    (folder / "true.tum").write_text(text)
    trace.save(folder / "trace.jsonl")
    there_and_back().save(folder / "map.json")
    return main(
        [
            "evaluate",
            str(folder / "map.json"),
            str(folder / "trace.jsonl"),
            "--truth",
            str(folder / "true.tum"),
            *options,
        ]
    )


@pytest.mark.parametrize(
    "form",
    [
        lambda text: text,
        lambda text: text.replace(" ", ","),
        lambda text: text.replace(" ", ", "),
        lambda text: text.replace(" ", "\t"),
        lambda text: text.replace("\n", "\r\n"),
        lambda text: text.replace("\n", "  # here\n"),
        lambda text: "\ufeff" + text,
        lambda text: text.replace("# timestamp", "timestamp"),
        lambda text: text.replace(HEAD, "\n\n# made by hand\n"),
        lambda text: "".join(reversed(text.splitlines(keepends=True))),
        lambda text: text + text.splitlines(keepends=True)[-1],
        lambda text: text.removesuffix("\n"),
    ],
)
def test_trajectory_is_read_in_each_form_of_tum(form: Callable[[str], str], tmp_path: Path) -> None:
    poses = told_poses(read(tmp_path, form(tum())).told_to(trace_at()))
    assert [pose and pose[:2] for pose in poses] == [pytest.approx((x, 0), abs=1e-9) for x in STOPS]
    assert [pose and abs(pose[2]) for pose in poses] == pytest.approx(
        [0, 0, math.pi, math.pi, math.pi]
    )


def test_evaluate_judges_by_a_trajectory(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert evaluated(tmp_path, tum(), trace_at(), "--json") == 0
    printed = capsys.readouterr()
    found = json.loads(printed.out)["poses"]
    assert printed.err == ""
    assert (found["places"]["judged"], found["places"]["returns"]) == (10, 2)
    assert (found["maps"][0]["places"]["precision"], found["maps"][0]["places"]["recall"]) == (1, 1)
    by_python = evaluate_visits(
        [there_and_back()], Trajectory.load(tmp_path / "true.tum").told_to(trace_at())
    )
    assert json.loads(json.dumps(by_python.to_dict())) == found


def test_pose_at_a_step_includes_the_offset_of_its_dstate(tmp_path: Path) -> None:
    trajectory = read(tmp_path, pose_line(0, 1, 2, math.pi / 2) + pose_line(1, 1, 4, math.pi / 2))
    told = trajectory.told_to(trace_at((0.5, 0.0), (2.0, 0.5, 0.25)))
    assert told_poses(told) == [
        pytest.approx((0.5, 5.0, math.pi / 2 + 0.25)),
        pytest.approx((0.5, 4.0, math.pi / 2 + 0.25)),
    ]
    named = Trace((Step(view="v", truth={"place": "A", "pose": [9, 9, 9]}, extra={"time": 0.0}),))
    assert trajectory.told_to(named).steps[0].truth == {
        "place": "A",
        "pose": [1.0, 2.0, pytest.approx(math.pi / 2)],
    }
    assert (
        trajectory.told_to(Trace((Step(view="v", truth="x0", extra={"time": 0.0}),)))
        .steps[0]
        .truth["dstate"]
        == "x0"
    )


@pytest.mark.parametrize(
    ("time", "pose"),
    [
        (0.0, (0, 0, 3.0)),
        (0.25, (0.5, 0, math.pi)),
        (-0.4, (0, 0, 3.0)),
        (-0.6, None),
        (0.9, (1, 0, -3.0)),
        (5.0, None),
        (8.6, (7, 0, 0)),
        (9.6, None),
    ],
)
def test_poses_are_interpolated_in_time(
    time: float, pose: tuple[float, float, float] | None
) -> None:
    at = Trajectory([(0.0, (0.0, 0.0, 3.0)), (0.5, (1.0, 0.0, -3.0)), (9.0, (7.0, 0.0, 0.0))]).at(
        time
    )
    assert at == pose if pose is None else at is not None and at[:2] == pytest.approx(pose[:2])
    assert pose is None or at is None or math.cos(at[2] - pose[2]) == pytest.approx(1)


@pytest.mark.parametrize(
    ("text", "times", "message"),
    [
        (
            tum(1e6),
            TIMES,
            "time: expected steps within 0.5 s of poses of .*true.tum, which are from 1001000 to "
            "1001080 s, got none: .*1000 to 1080 s; take",
        ),
        (
            tum(-1000),
            TIMES,
            "which are from 0 to 80 s, got none: steps are from 1000 to 1080 s; "
            "take .* or shift its times",
        ),
        (
            tum().replace(" 0.1 ", " 0 ").replace("\n1", "\n1000000000001"),
            TIMES,
            "the trajectory seems to have nanoseconds",
        ),
        (
            tum(),
            (None,) * 5,
            "time: expected the time of some step, in seconds, got none; import the trace from",
        ),
        (HEAD, TIMES, "true.tum: expected lines of timestamp tx ty tz qx qy qz qw, got none"),
        ("", TIMES, "true.tum: expected lines of timestamp"),
        (
            tum() + "1 2 3\n",
            TIMES,
            "true.tum:163: expected the numbers timestamp .*, got '1 2 3'; mend the line",
        ),
        (
            "1 0 0 0 0 1 0 0 0 0 1 0\n",
            TIMES,
            "true.tum:1: .*this looks like a file of KITTI, which has no times",
        ),
        ("1" + " 0" * 16, TIMES, "true.tum:1: .*EuRoC"),
        ("1 2 3 4 0 0 0 nan\n", TIMES, "true.tum:1: expected the numbers"),
        ("1 2 x 4 0 0 0 1\n", TIMES, "true.tum:1: expected the numbers"),
        (
            "1 2 3 4 0 0 0 0\n",
            TIMES,
            "true.tum:1: qx qy qz qw: expected a quaternion of length 1, got one of 0",
        ),
        ("1 2 3 4 1 1 1 1\n", TIMES, "true.tum:1: qx qy qz qw: expected a quaternion"),
        (
            pose_line(1, 2) + pose_line(1, 3),
            TIMES,
            "true.tum: expected one pose at a time, got different ones at 1 s",
        ),
        ("a\0b", TIMES, "true.tum"),
    ],
)
def test_trajectory_that_does_not_fit_is_refused(
    text: str,
    times: tuple[float | None, ...],
    message: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(TraceError, match=message):
        read(tmp_path, text).told_to(trace_at(times))
    assert evaluated(tmp_path, text, trace_at(times)) == 1
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.startswith("ssh-abduction: ")


def test_binary_trajectory_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(TraceError, match="expected a trajectory in TUM format, got another file"):
        read(tmp_path, b"\xff\xfe\0\x01")


@pytest.mark.filterwarnings("default")
def test_note_counts_steps_without_truth(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert evaluated(tmp_path, tum(), trace_at((*TIMES[:3], 5.0, None))) == 0
    printed = capsys.readouterr()
    assert "2 of 5 steps have no pose within 0.5 s of their time, and no truth" in printed.err
    assert "left out: 7 pairs, as poses do not tell how far apart they are" in printed.out


@pytest.mark.filterwarnings("default")
def test_evaluate_says_that_no_pair_can_be_judged(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert evaluated(tmp_path, tum(), trace_at((TIMES[0], None, None, None, None))) == 0
    printed = capsys.readouterr()
    assert (
        "judged by poses: expected pairs of visits to judge, got none of 5 visits; " in printed.err
    )
    assert "left out: 10 pairs, as poses do not tell how far apart they are" in printed.out
    assert evaluated(tmp_path, tum(), trace_at((1000.0, 1000.5, 1001.0, 1001.5, 1002.0))) == 0
    assert (
        "left out: 10 pairs within this distance, as the robot made no visit farther away"
        in capsys.readouterr().out
    )


@pytest.mark.parametrize(
    "text",
    [
        "".join(
            f"{t} {t} 0 0 -0.5 0.5 -0.5 0.5\n" for t in range(9)
        ),  # of a camera: its z axis looks ahead
        "".join(f"{t} 0 0 {t} 0 0 0 1\n" for t in range(9)),
    ],
)
def test_trajectory_off_the_floor_gives_a_warning(text: str, tmp_path: Path) -> None:
    with pytest.warns(TrajectoryWarning, match="expected a trajectory on a floor"):
        read(tmp_path, text)


def test_trajectory_given_as_relations_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Both have eight numbers a line. A trajectory that was read as relations judged no pair."""
    for text in (tum(), pose_line(1000, 0), HEAD + "5 2 3 4 0 0 0 1\n"):
        (tmp_path / "relations").write_text(text)
        trace_at().save(tmp_path / "trace.jsonl")
        there_and_back().save(tmp_path / "map.json")
        files = [str(tmp_path / name) for name in ("map.json", "trace.jsonl")]
        assert main(["evaluate", *files, f"--set=relations={tmp_path / 'relations'}"]) == 1
        assert (
            "got a trajectory: each line ends in a quaternion; "
            "give it as the truth of the steps (--truth)" in capsys.readouterr().err
        )
