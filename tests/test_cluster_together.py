"""Images of several drives, clustered together by the command `cluster`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from perception.images import images_of
from simulator.tours import simulate
from simulator.world import World
from ssh_abduction import Solution, Trace
from ssh_abduction.cli import main
from ssh_abduction.data.trace import images_file

NAMES = ("monday.jsonl", "tuesday.jsonl")


@pytest.fixture(scope="module")
def simulated() -> tuple[Trace, Trace]:
    """Two drives through one room. The second starts at the fourth dstate of the first."""
    world = World.named("notched-rectangle")
    return simulate(world, tours=2, seed=1)[:10], simulate(world, tours=2, seed=2)[3:14]


@pytest.fixture
def drives(
    simulated: tuple[Trace, Trace], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> list[Trace]:
    """The two drives in files of their own."""
    monkeypatch.chdir(tmp_path)
    for trace, name in zip(simulated, NAMES, strict=True):
        replace(trace, name=Path(name).stem).save(name)
    return [Trace.load(name) for name in NAMES]


def _true_dstates(traces: Sequence[Trace]) -> list[str]:
    return [step.truth["dstate"] for trace in traces for step in trace.steps if step.truth]


def _views(*files: str) -> list[object]:
    return [view for file in files for view in Trace.load(file).views]


def _agree(first: Sequence[object], other: Sequence[object]) -> bool:
    """Whether two lists put the same steps into one group."""
    pairs = set(zip(first, other, strict=True))
    return len(pairs) == len(set(first)) == len(set(other))


@pytest.mark.slow
def test_drives_that_are_clustered_together_get_common_views(
    drives: list[Trace], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["cluster", *reversed(NAMES), "--together", "--k", "4", "-o", "views/of both"]) == 0
    assert "4 views of 21 images in views/of both\n" in capsys.readouterr().out
    written = [f"views/of both/{name}" for name in NAMES]
    together = _views(*written)
    assert [Trace.load(file).steps[3].image for file in written] == [
        trace.steps[3].image for trace in drives
    ]
    # Each dstate has one view on both days.
    assert len(set(zip(_true_dstates(drives), together, strict=True))) == 8
    for name in NAMES:
        assert main(["cluster", name, "--k", "4", "-o", f"alone-{name}"]) == 0
    separate = [f"alone-{name}" for name in NAMES]
    assert not _agree(together, _views(*separate))  # a view is another one on the other day
    capsys.readouterr()
    assert main(["solve", *separate, "--together", "--set", "weigh=count"]) == 0
    assert (
        "alone-monday.jsonl and alone-tuesday.jsonl seem to have different views of the same names"
        in capsys.readouterr().err
    )
    assert main(["solve", *written, "--together", "--work-limit", "1", "-o", "maps.json"]) == 0
    assert "different views" not in capsys.readouterr().err
    (ssh_map,) = Solution.load("maps.json").maps
    assert _agree([label for part in ssh_map.labels for label in part], _true_dstates(drives))


@pytest.mark.filterwarnings("ignore:the map of 8 dstates is the best that was found")
def test_images_in_several_files_get_one_file(
    drives: list[Trace], refuses: Callable[[Sequence[str], str], None]
) -> None:
    table = np.concatenate([images_of(trace) for trace in drives])
    for name, trace in zip(NAMES, drives, strict=True):
        file = f"{Path(name).stem}.npy"
        np.save(file, images_of(trace))
        steps = tuple(replace(step, image=i) for i, step in enumerate(trace.steps))
        replace(trace, steps=steps, images=file).save(name)
    refuses(["solve", *NAMES, "--together"], "put them into one file (the command 'cluster --tog")
    assert main(["cluster", *NAMES, "--together", "--k", "4", "-o", "both"]) == 0
    written = [f"both/{name}" for name in NAMES]
    np.testing.assert_array_equal(
        np.concatenate([images_of(Trace.load(file)) for file in written]), table
    )
    Path("joint").mkdir()
    joint = "joint_trace=joint/trace.jsonl"
    limited = ["--set", joint, "--work-limit", "1", "-o", "joint/maps.json"]  # any map will do
    assert main(["solve", *written, "--together", *limited]) == 0
    trace = Trace.load("joint/trace.jsonl")
    assert images_file(trace) == Path("joint/../both/images.npz")
    np.testing.assert_array_equal(images_of(trace), table)
    assert main(["train", "joint/maps.json", "joint/trace.jsonl", "-o", "joint/r.skops"]) == 0
    # Cluster again in the same folder.
    assert main(["cluster", *written, "--together", "--k", "4", "-o", "both"]) == 0
    np.testing.assert_array_equal(images_of(Trace.load("joint/trace.jsonl")), table)


def test_traces_that_cannot_be_clustered_together_are_refused(
    drives: list[Trace], refuses: Callable[[Sequence[str], str], None]
) -> None:
    monday, tuesday = NAMES
    Path("other").mkdir()
    drives[0].save("other/monday.jsonl")
    short = [replace(step, image=step.image[:9]) for step in drives[1].steps]  # type: ignore[index]
    replace(drives[1], steps=tuple(short)).save("short.jsonl")
    for words, said in (
        ([monday, tuesday, "-o", "x"], "expected one trace, or --together, got several"),
        ([monday, "-", "--together", "-o", "x"], "expected files to read and a folder to write"),
        ([monday, tuesday, "--together", "-o", "-"], "expected files to read and a folder to"),
        ([monday, "other/monday.jsonl", "--together", "-o", "x"], "different file names"),
        ([monday, tuesday, "--together", "-o", tuesday], "expected a folder to write, got a file"),
        (
            [monday, "short.jsonl", "--together", "-o", "x"],
            "ssh-abduction: short.jsonl: image: expected 180 ranges, as monday.jsonl has, got 9",
        ),
    ):
        refuses(["cluster", *words], said)
    assert not Path("x").exists()
