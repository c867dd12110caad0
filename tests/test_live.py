"""A log is imported while it comes: the same trace as from a file, and the same warnings."""

from __future__ import annotations

import gzip
import io
import math
import random
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import pytest
from coarse import every_second_beam, hall
from test_distinctive import log_of
from test_log_checks import backwards, in_degrees, of_two_clocks, with_poses

from perception.errors import LogError
from perception.places.importing import import_log
from perception.places.live import LOOKS, LiveLog, LivePlace, Teller, import_live, watched
from perception.readers.logs import SURVEYED, live_log, read_log
from perception.readers.scans import RobotLog, Scan
from perception.readers.writers import write_carmen
from ssh_abduction.cli import main
from ssh_abduction.data.trace import Trace

Scans = Sequence[Scan]


@pytest.fixture(scope="module")
def scans() -> tuple[Scan, ...]:
    """A drive of a tour through a hall, a scan of 90 beams every half metre."""
    return every_second_beam(hall(every=0.5)[:240])


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The log of a drive out of a side corridor of a hall and back."""
    path = tmp_path_factory.mktemp("logs") / "drive.log"
    write_carmen(path, [replace(scan, corrected=None) for scan in hall()[:80]])
    return path


def given(monkeypatch: pytest.MonkeyPatch, data: bytes) -> None:
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(data)))


@pytest.mark.parametrize("pack", [bytes, pytest.param(gzip.compress, marks=pytest.mark.slow)])
def test_import_of_a_pipe_prints_visits_and_equals_import_of_a_file(
    pack: Callable[[bytes], bytes],
    drive: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    given(monkeypatch, pack(drive.read_bytes()))
    assert main(["import", "-", "-o", str(tmp_path / "live.jsonl")]) == 0
    *shown, _ = capsys.readouterr().out.splitlines()
    done = import_log(read_log(drive))
    assert len(shown) == len(done.visits) >= 3
    assert all(f"visit {k}, scans {done.visits[k].begin} to" in shown[k] for k in range(len(shown)))
    live = Trace.load(tmp_path / "live.jsonl")
    assert live.steps == done.trace.steps
    assert live.closures == done.trace.closures


@pytest.mark.slow
def test_import_of_a_pipe_counts_diverging_lanes_at_the_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    # In a wide corridor, the robot comes back on another lane.
    walls = [(0, -2, 24, -2), (0, 2, 24, 2), (0, -2, 0, 2), (24, -2, 24, 2)]
    log, _ = log_of(walls, [(1, -1.4), (21, -1.4), (14, -1.4), (11, 1.4), (1, 1.4)])
    write_carmen(tmp_path / "lanes.log", log.scans)
    given(monkeypatch, (tmp_path / "lanes.log").read_bytes())
    assert main(["import", "-", "-o", str(tmp_path / "live.jsonl")]) == 0
    *shown, last, _ = capsys.readouterr().out.splitlines()
    assert last == "at the end of the drive: 2 more visits where stretches of it diverge"
    visits = import_log(read_log(tmp_path / "lanes.log")).visits
    assert len(visits) == len(shown) + 2
    assert sum(math.dist(visit.middle, (12, 0.4)) < 1.0 for visit in visits) == 2


@pytest.mark.slow
def test_trace_on_standard_output_has_no_other_lines(
    drive: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    given(monkeypatch, drive.read_bytes())
    assert main(["import", "-", "-o", "-"]) == 0
    out, err = capsys.readouterr()
    assert all(line.startswith("{") for line in out.splitlines())
    assert len(out.splitlines()) > 3
    assert "visit 0, scans" in err


@pytest.mark.parametrize(
    ("data", "options", "told"),
    [
        (b"VERTEX2 0 0 0 0\nROBOTLASER1 0\n", [], "expected lines of CARMEN, got another log"),
        (b"nothing\n", [], "expected lines of CARMEN, got another log"),
        (b"", [], "expected lines of CARMEN, got nothing; check the program that sends the log"),
        (b"", ["--format", "mcap"], "got another format or a topic"),
    ],
)
def test_import_of_a_pipe_refuses_other_formats_and_options(
    data: bytes,
    options: list[str],
    told: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    given(monkeypatch, data)
    assert main(["import", "-", *options, "-o", "-"]) == 1
    assert told in capsys.readouterr().err


def test_pipe_is_read_line_by_line(drive: Path) -> None:
    """The first scan is there long before the end of the pipe."""
    lines = drive.read_bytes().splitlines(keepends=True) * 20
    read = 0

    class Slow(io.BytesIO):
        def readline(self, size: int | None = -1) -> bytes:
            nonlocal read
            read += 1
            return super().readline(size)

    first = next(live_log(Slow(b"".join(lines))))
    assert isinstance(first, Scan)
    assert 2 * SURVEYED <= read < len(lines) / 2


def notes_of(scans: Scans) -> str:
    said: list[str] = []
    live = LiveLog(tell=said.append)
    for scan in watched(scans, live.tell):
        live.add(scan)
    live.compare()
    assert len(said) == len(set(said))
    return "\n".join(said)


def mirrored(scans: Scans) -> Scans:
    return [replace(scan, ranges=scan.ranges[::-1]) for scan in scans]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "told"),
    [
        (backwards, "drives backwards all the way"),
        (in_degrees, "headings of the odometry are read as degrees"),
        (lambda scans: with_poses(scans, lambda x, y, h: (100 * x, 100 * y, h)), "as centimetres"),
        (of_two_clocks, "The clock starts anew before scan 60"),
        (mirrored, "the laser hangs upside down"),
    ],
)
def test_stream_gets_the_warnings_of_a_log(
    change: Callable[[Scans], Scans], told: str, scans: tuple[Scan, ...]
) -> None:
    assert told in notes_of(change(scans))


@pytest.mark.slow
def test_good_stream_gets_no_warning(scans: tuple[Scan, ...]) -> None:
    assert not notes_of(scans)
    # A robot that stands for a while is not doubted, either.
    assert not notes_of([scans[0]] * (LOOKS[0] + 50) + list(scans[:60]))


def test_shuffled_stream_is_refused_before_matching(scans: tuple[Scan, ...]) -> None:
    mixed = random.Random(1).sample(scans, len(scans))
    with pytest.raises(LogError, match="in random order"):
        next(watched(mixed, Teller(print)))


def test_stream_with_two_odometry_sources_is_refused(scans: tuple[Scan, ...]) -> None:
    two = [
        replace(scan, odometry=(scan.odometry[0] + 30 * (i % 2), *scan.odometry[1:]))
        for i, scan in enumerate(scans)
    ]
    with pytest.raises(LogError, match="odometry of one source"):
        next(watched(two, Teller(print)))


def test_restarted_clock_does_not_cut_a_matching_drive(scans: tuple[Scan, ...]) -> None:
    some = [
        replace(scan, time=(scan.time or 0.0) - (1e4 if i > 40 else 0))
        for i, scan in enumerate(scans[:80])
    ]
    done = import_log(RobotLog(tuple(some)))
    assert done.track.cuts == ()
    (note,) = [note for note in done.notes if "clock" in note]
    assert "while the odometry goes on" in note
    assert not [note for note in done.notes if "jumps" in note]


def test_import_of_an_empty_pipe_is_refused() -> None:
    with pytest.raises(LogError, match="expected scans, got none"):
        import_live([])


def test_a_log_that_grew_is_imported_as_a_whole(scans: tuple[Scan, ...]) -> None:
    """Also if the odometry jumps, and if the log is looked at while it grows."""
    far = [
        replace(scan, odometry=(scan.odometry[0] + 30 * (i >= 50), *scan.odometry[1:]))
        for i, scan in enumerate(scans)
    ]
    for drive in (scans[:64], far[:64]):
        live, seen = LiveLog(), []
        for i, scan in enumerate(drive):
            seen += live.add(scan)[1]
            if i == 40:
                live.places()
        whole = import_log(RobotLog(tuple(drive)))
        done = live.finish()
        assert done.trace.steps == whole.trace.steps
        assert done.trace.closures == whole.trace.closures
        assert done.notes == whole.notes
        assert done.poses.tolist() == whole.poses.tolist()
        assert [visit.scan for visit in seen] == [visit.scan for visit in live.visits]


@pytest.mark.slow
def test_places_are_known_soon_and_stay(scans: tuple[Scan, ...]) -> None:
    live, early = LiveLog(), list[LivePlace]()
    for scan in scans[:120]:
        live.add(scan)
    early = live.places()
    assert any(place.final for place in early)
    assert not all(place.final for place in early)
    for scan in scans[120:]:
        live.add(scan)
    late = live.places()
    assert len(late) >= len(early)
    for place in early:
        if place.final:
            assert min(math.dist(place.middle, other.middle) for other in late) < 0.5
