"""Bags as robots leave them.

They come in parts, packed, cut, with wrong clocks, with several lasers, or with odometry of several
sources.
"""

from __future__ import annotations

import bz2
import errno
import gzip
import lzma
import math
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_readers import SMALL, Messages, agree, bag, drive

from perception.errors import LogError
from perception.readers.lines import zstd_module
from perception.readers.logs import read_log
from perception.readers.writers import write_bag, write_carmen
from ssh_abduction.cli import main
from ssh_abduction.data.odometry import Pose

SCANS = drive(40, SMALL)
PACK: dict[str, Callable[[bytes], bytes]] = {
    "gz": gzip.compress,
    "bz2": bz2.compress,
    "xz": lzma.compress,
    "zst": lambda data: bytes(zstd_module().compress(data)),
}
FILES = {"ros1": "drive.bag", "mcap": "drive.mcap", "ros2": "drive.db3"}


def written(folder: Path, format: str, scans: list[Any] = SCANS) -> Path:
    """The file of a bag."""
    target = folder / FILES[format]
    if format != "ros2":
        write_bag(target, scans)
        return target
    write_bag(folder / "folder", scans)
    shutil.move(folder / "folder" / "folder.db3", target)
    shutil.rmtree(folder / "folder")
    return target


def notes(log: Any) -> str:
    return " ".join(log.notes)


# Files


@pytest.mark.parametrize(
    ("format", "ending"),
    [*(("carmen", ending) for ending in PACK), *((format, "gz") for format in FILES)],
)
def test_packed_logs_are_read_whatever_their_name(tmp_path: Path, format: str, ending: str) -> None:
    if format == "carmen":
        file = tmp_path / "drive.log"
        write_carmen(file, SCANS)
    else:
        file = written(tmp_path, format)
    packed = tmp_path / "data"
    packed.write_bytes(PACK[ending](file.read_bytes()))
    log = read_log(packed)
    assert log.format == format
    assert len(log) == len(SCANS)
    assert all(map(agree, log.scans, SCANS))


@pytest.mark.parametrize("ending", PACK)
def test_cut_packed_log_is_an_error_that_names_the_command_to_unpack(
    tmp_path: Path, ending: str
) -> None:
    write_carmen(tmp_path / "a.log", SCANS)
    data = PACK[ending]((tmp_path / "a.log").read_bytes())
    (tmp_path / "a.log").write_bytes(data[: len(data) // 2])
    with pytest.raises(
        LogError, match=r"a\.log: expected whole data of .*, but after line \d+ .*cat FILE > PART"
    ):
        read_log(tmp_path / "a.log")


def test_bytes_after_a_packed_log_are_refused_as_damage(tmp_path: Path) -> None:
    write_carmen(tmp_path / "a.log", SCANS)
    (tmp_path / "a.log").write_bytes(gzip.compress((tmp_path / "a.log").read_bytes()) + b"more")
    with pytest.raises(LogError, match=r"but after line \d+ they are damaged \("):
        read_log(tmp_path / "a.log")


@pytest.mark.parametrize("format", FILES)
@pytest.mark.parametrize("share", [0.4, 0.97])
def test_the_intact_part_of_a_cut_bag_is_read_with_a_note(
    tmp_path: Path, format: str, share: float
) -> None:
    file = written(tmp_path, format, drive(120, SMALL))
    data = file.read_bytes()
    file.write_bytes(data[: int(len(data) * share)])
    log = read_log(file)
    assert (share - 0.35) * 120 < len(log) <= 120
    assert f"{file} is cut, or was never closed" in notes(log)
    assert "whole messages are read" in notes(log)


@pytest.mark.parametrize("format", ["ros1", "mcap"])
def test_cut_compressed_chunk_is_read_up_to_the_cut(tmp_path: Path, format: str) -> None:
    """Recorders pack many messages in a chunk; the last chunk is the one that is cut."""
    from rosbags import rosbag1, rosbag2
    from rosbags.interfaces import Connection

    plain = written(tmp_path, format, drive(400))
    target = tmp_path / f"packed{plain.suffix}"
    if format == "ros1":
        reader: Any = rosbag1.Reader(plain)
        writer: Any = rosbag1.Writer(target)
        writer.set_compression(rosbag1.Writer.CompressionFormat.LZ4)
    else:
        reader, writer = (
            rosbag2.Reader(plain),
            rosbag2.Writer(target, version=9, storage_plugin=rosbag2.StoragePlugin.MCAP),
        )
        writer.set_compression(rosbag2.CompressionMode.STORAGE, rosbag2.CompressionFormat.ZSTD)

    def added(connection: Connection) -> Any:
        told = (
            {"md5sum": connection.digest}
            if format == "ros1"
            else {"rihs01": connection.digest or "RIHS01_0"}
        )
        return writer.add_connection(
            connection.topic, connection.msgtype, msgdef=connection.msgdef.data, **told
        )

    with reader, writer:
        topics = {connection.id: added(connection) for connection in reader.connections}
        for connection, time, raw in reader.messages():
            writer.write(topics[connection.id], time, raw)
    file = next(target.glob("*.mcap")) if target.is_dir() else target
    data = file.read_bytes()
    file.write_bytes(data[: int(0.7 * len(data))])
    log = read_log(file)
    assert 100 < len(log) < 400
    assert "is cut" in notes(log)


def parts(folder: Path, ending: str, count: int = 3) -> None:
    """The parts of a drive. Part 10 is last by number; only the first has static transforms."""
    folder.mkdir()
    size = len(SCANS) // count
    for k in range(count):
        one = SCANS[k * size : (k + 1) * size] if k < count - 1 else SCANS[k * size :]
        number = k if k < count - 1 else 10
        if ending == ".db3":
            write_bag(folder / "whole", one)
            shutil.move(folder / "whole" / "whole.db3", folder / f"drive_{number}.db3")
            shutil.rmtree(folder / "whole")
        else:
            write_bag(folder / f"drive_{number}{ending}", one)


@pytest.mark.parametrize(
    ("ending", "metadata"),
    [
        (".db3", None),
        (".mcap", None),
        (".bag", None),
        (".mcap", "rosbag2_bagfile_information: {version: 9, storage_identifier: ''}\n"),
        (".db3", ""),
    ],
)
def test_bag_parts_without_usable_metadata_are_read_as_one_drive(
    tmp_path: Path, ending: str, metadata: str | None
) -> None:
    parts(tmp_path / "drive", ending)
    if metadata is not None:
        (tmp_path / "drive" / "metadata.yaml").write_text(metadata)
    log = read_log(tmp_path / "drive")
    assert len(log) == len(SCANS)
    assert all(map(agree, log.scans, SCANS))
    assert "3 parts are read as one drive, from drive_0" in notes(log)
    assert "These parts are not there: 2, 3, 4, 5, 6, …" in notes(log)
    assert ("metadata.yaml cannot be used" in notes(log)) == (metadata is not None)


def test_single_bag_part_is_read_with_a_note_about_other_parts(tmp_path: Path) -> None:
    parts(tmp_path / "drive", ".db3")
    log = read_log(tmp_path / "drive" / "drive_0.db3")
    assert len(log) == len(SCANS) // 3
    assert (
        "drive_0.db3 is one part of a drive, and is read alone. Beside it lie drive_1.db3, "
        "drive_10.db3: name the folder" in notes(log)
    )
    (tmp_path / "drive" / "drive_1.db3").rename(tmp_path / "drive_1.db3")
    assert "These parts are not there: 0" in notes(read_log(tmp_path / "drive_1.db3"))


def test_damaged_bag_part_is_left_out_and_the_others_are_read(tmp_path: Path) -> None:
    parts(tmp_path / "drive", ".db3")
    first, second, _ = sorted((tmp_path / "drive").iterdir())
    (tmp_path / "drive" / "drive_0.db3.zstd").write_bytes(PACK["zst"](first.read_bytes()))
    first.unlink()
    second.write_bytes(b"")
    log = read_log(tmp_path / "drive")
    assert len(log) == len(SCANS) - len(SCANS) // 3
    assert "A part was not read." in notes(log)
    assert "drive_1.db3" in notes(log)


def test_a_folder_of_several_drives_is_refused(tmp_path: Path) -> None:
    for name in ("monday", "tuesday"):
        write_bag(tmp_path / f"{name}.mcap", SCANS)
    with pytest.raises(
        LogError,
        match=(
            r"expected the parts of one drive, .* got monday\.mcap, tuesday\.mcap; name one of "
            r"the files, or ros2 bag reindex"
        ),
    ):
        read_log(tmp_path)


def test_note_says_that_metadata_omits_a_bag_part(tmp_path: Path) -> None:
    write_bag(tmp_path / "drive", SCANS)
    shutil.copy(tmp_path / "drive" / "drive.db3", tmp_path / "drive" / "drive_1.db3")
    log = read_log(tmp_path / "drive")
    assert len(log) == len(SCANS)
    assert "names 1 of the 2 files beside it" in notes(log)


# A full disk


def raise_disk_full(*_: Any, **__: Any) -> Any:
    raise OSError(errno.ENOSPC, "No space left on device")


def test_full_disk_while_unpacking_is_a_clear_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "a.mcap.gz").write_bytes(gzip.compress(written(tmp_path, "mcap").read_bytes()))
    monkeypatch.setattr(shutil, "copyfileobj", raise_disk_full)
    with pytest.raises(
        LogError,
        match=(
            r"a\.mcap\.gz: expected room for a temporary copy in .*, got a full disk; free some, "
            r"or name another folder \(TMPDIR"
        ),
    ):
        read_log(tmp_path / "a.mcap.gz")


@pytest.mark.parametrize("name", ["drive", "drive.mcap", "drive.bag"])
def test_full_disk_while_writing_a_bag_leaves_no_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    from rosbags import rosbag1, rosbag2

    def no_room(*_: Any) -> None:
        import apsw

        raise (
            apsw.FullError("database or disk is full")
            if name == "drive"
            else OSError(errno.ENOSPC, "No space left on device")
        )

    for writer in (rosbag1.Writer, rosbag2.Writer):
        monkeypatch.setattr(writer, "write", no_room)
    with pytest.raises(
        LogError, match=rf"{name}: expected a bag that can be written: .*(full|No space)"
    ):
        write_bag(tmp_path / name, SCANS)
    assert not list(tmp_path.iterdir())


# Clocks

TIMES = [0.5 * i for i in range(240)]


def clocks(
    tmp_path: Path,
    scan: Callable[[float], float],
    odometer: Callable[[float], float],
    recorded: Callable[[float], float],
) -> Any:
    """Read a drive at one metre per second with these clocks of laser, odometer and recorder."""

    def messages(m: Messages) -> list[tuple[str, float, Any]]:
        both = [
            ("/odom", t, m.odometry(100 + odometer(t), (t, 0.0, 0.0), base="laser")) for t in TIMES
        ]
        both += [("/scan", t + 0.01, m.scan(100 + scan(t))) for t in TIMES]
        return [
            (topic, 100 + recorded(t), message)
            for topic, t, message in sorted(both, key=lambda one: one[1])
        ]

    log = read_log(bag(tmp_path / "bag", messages))
    assert len(log) >= 0.99 * len(TIMES)
    return log


def true_clock(t: float) -> float:
    return t


def largest_error(log: Any) -> float:
    """Largest error of the odometry for most scans, in metres and so in seconds."""
    return max(abs(scan.odometry[0] - (scan.line - 1) * 0.5) for scan in log.scans)


HALF = TIMES[-1] / 2
BROKEN: dict[str, Callable[[float], float]] = {
    "10 s back from midway": lambda t: t - 10 * (t > HALF),
    "10 s on from midway": lambda t: t + 10 * (t > HALF),
    "2 % fast": lambda t: 1.02 * t,
    "all equal": lambda t: 0.0,
    "0 from midway": lambda t: t if t < HALF else -100.0,
    "0 up to midway": lambda t: t if t > HALF else -100.0,
    "an hour on": lambda t: t + 3600,
}


@pytest.mark.parametrize(
    ("what", "topic"), [*((what, "scan") for what in BROKEN), ("10 s back from midway", "odom")]
)
def test_recording_times_replace_broken_header_times(tmp_path: Path, what: str, topic: str) -> None:
    broken = BROKEN[what]
    log = clocks(
        tmp_path, *((broken, true_clock) if topic == "scan" else (true_clock, broken)), true_clock
    )
    assert largest_error(log) < 0.1
    assert "The times in the headers contradict themselves" in notes(log)
    assert "The times of recording are used." in notes(log)


@pytest.mark.parametrize(
    ("recorded", "said"),
    [
        (true_clock, ""),
        (lambda t: t + 0.3 * math.sin(t), ""),  # Late by itself, by varying amounts.
        (lambda t: t + 3600 + 0.05 * t, ""),  # Another clock than that of both headers.
        (lambda t: 0.0, "were all recorded at one time"),
        (lambda t: 10 * math.ceil(t / 10), "were recorded in 12 bursts, each of up to 9.5 s"),
    ],
)
def test_header_times_are_used_if_recording_times_are_worse(
    tmp_path: Path, recorded: Callable[[float], float], said: str
) -> None:
    log = clocks(tmp_path, true_clock, true_clock, recorded)
    assert largest_error(log) < 0.1
    assert said in notes(log)
    assert ("The times in the headers are used." in notes(log)) == bool(said)


def test_note_says_that_both_clocks_are_broken(tmp_path: Path) -> None:
    log = clocks(
        tmp_path, BROKEN["10 s back from midway"], true_clock, lambda t: 10 * math.ceil(t / 10)
    )
    assert "The times of recording are no better" in notes(log)


# Lasers


def two_lasers(m: Messages, *topics: str) -> list[tuple[str, float, Any]]:
    """Two lasers, one ahead and one behind, whose scans alternate."""
    found: list[tuple[str, float, Any]] = [
        ("/tf_static", 0.5, m.transform("base_link", "front", (0.2, 0.0, 0.0))),
        ("/tf_static", 0.5, m.transform("base_link", "rear", (-0.2, 0.0, math.pi))),
    ]
    for t in range(1, 9):
        found.append(("/odom", t, m.odometry(t, (0.1 * t, 0.0, 0.0))))
        found.append((topics[t % len(topics)], t, m.scan(t, "rear" if t % 2 else "front")))
    return found


def test_each_scan_has_the_mount_of_its_own_frame(tmp_path: Path) -> None:
    log = read_log(bag(tmp_path / "one", lambda m: two_lasers(m, "/scan")))
    assert [round(scan.laser.mount[2], 3) for scan in log.scans] == [3.142, 0.0] * 4
    assert "The scans are of several frames (4 of rear, 4 of front)" in " ".join(log.sources)
    path = bag(tmp_path / "two", lambda m: two_lasers(m, "/front", "/rear"))
    with pytest.raises(LogError, match=r"name one with --set scan_topic=TOPIC, once for each"):
        read_log(path)
    both = read_log(path, scan_topic=["/front", "rear"])
    assert [scan.laser.mount for scan in both.scans] == [scan.laser.mount for scan in log.scans]
    assert {scan.laser.mount[0] for scan in read_log(path, scan_topic="rear").scans} == {-0.2}


@pytest.mark.parametrize("topic", ["/tf_static", "/tf"])
def test_later_of_two_laser_transforms_is_used_with_a_note(tmp_path: Path, topic: str) -> None:
    def messages(m: Messages) -> list[tuple[str, float, Any]]:
        mounts: list[Pose] = [(0.2, 0.0, 0.0), (0.2, 0.0, 0.001), (0.2, 0.0, math.pi)]
        return [
            *[
                (topic, 0.5 + i / 10, m.transform("base_link", "laser", mount))
                for i, mount in enumerate(mounts)
            ],
            *[("/odom", t, m.odometry(t, (t, 0.0, 0.0))) for t in (1.0, 2.0)],
            ("/scan", 1.5, m.scan(1.5)),
        ]

    log = read_log(bag(tmp_path / "bag", messages))
    assert abs(log.scans[0].laser.mount[2]) == pytest.approx(math.pi)
    assert (
        "The 3 transforms from base_link to laser, by which the laser is mounted, contradict "
        "each other by up to 0.00 m and 180 degrees" in notes(log)
    )


def test_repeated_equal_transform_gives_no_note(tmp_path: Path) -> None:
    def messages(m: Messages) -> list[tuple[str, float, Any]]:
        return [
            *[
                ("/tf", t, m.transform("base_link", "laser", (0.2, 0.0, 0.1), t))
                for t in (1.0, 1.5, 2.0)
            ],
            *[("/odom", t, m.odometry(t, (t, 0.0, 0.0))) for t in (1.0, 2.0)],
            ("/scan", 1.5, m.scan(1.5)),
        ]

    log = read_log(bag(tmp_path / "bag", messages))
    assert "contradict" not in notes(log)


def test_first_echoes_of_a_laser_with_several_are_read(tmp_path: Path) -> None:
    def messages(m: Messages) -> list[tuple[str, float, Any]]:
        scan = m.scan(1.5)
        echo = m.types["sensor_msgs/msg/LaserEcho"]
        beams = [[1.0, 3.0], [2.0], [], [4.0, 5.0], [9.0]]
        scan = m.types["sensor_msgs/msg/MultiEchoLaserScan"](
            header=scan.header,
            angle_min=-1.0,
            angle_max=1.0,
            angle_increment=0.5,
            time_increment=0.0,
            scan_time=0.1,
            range_min=0.1,
            range_max=8.0,
            ranges=[echo(echoes=np.array(beam, dtype=np.float32)) for beam in beams],
            intensities=[],
        )
        return [
            *[("/odom", t, m.odometry(t, (t, 0.0, 0.0))) for t in (1.0, 2.0)],
            ("/echoes", 1.5, scan),
        ]

    log = read_log(bag(tmp_path / "bag", messages))
    assert log.scans[0].ranges.tolist() == [1, 2, math.inf, 4, math.inf]


# Odometry of several sources


def alternate(m: Messages, kind: str) -> list[tuple[str, float, Any]]:
    """A robot that drives along x, while another program publishes other poses."""
    found: list[tuple[str, float, Any]] = []
    for i in range(100):
        t = 1.0 + 0.1 * i
        here, there = (0.1 * i, 0.0, 0.0), (5.0 + 0.09 * i, 3.0, 1.0)
        if kind == "topic":
            found += [("/odom", t, m.odometry(t, here, "laser"))]
            found += [("/odom", t + 0.05, m.odometry(t + 0.05, there, "laser"))] * (i % 3 < 2)
        elif kind == "frames":
            found += [
                ("/odom", t, m.odometry(t, here, "laser")),
                ("/odom", t, m.odometry(t, there, "camera")),
            ][:: 1 if i % 2 else -1]
            found += [
                ("/odom", t + 0.05, m.odometry(t + 0.05, (0.1 * i + 0.05, 0.0, 0.0), "laser"))
            ]
        elif kind == "transforms":
            found += [("/tf", t, m.transform("odom", "laser", here, t))]
            found += [("/tf", t + 0.05, m.transform("odom", "laser", there, t + 0.05))] * (
                i % 3 < 2
            )
        else:
            found += [
                ("/tf", t, m.transform("odom", "laser", here, t)),
                ("/tf", t, m.transform("world", "laser", there, t)),
            ]
        found.append(("/scan", t + 0.02, m.scan(t)))
    return found


@pytest.mark.parametrize(
    ("kind", "said"),
    [
        (
            "topic",
            (
                "Several sources publish /odom, whose poses alternate, up to 5.8 m apart: 100 and "
                "67 of 167 messages"
            ),
        ),
        (
            "frames",
            (
                "Several sources publish /odom: 100 from odom to camera, 200 from odom to laser. "
                "Those from odom to laser are read"
            ),
        ),
        (
            "transforms",
            (
                "Several sources publish the transforms from odom to laser, whose poses "
                "alternate, up to 5.8 m apart"
            ),
        ),
        ("parents", ""),
    ],
)
def test_odometry_of_two_publishers_is_read_from_one_with_a_note(
    tmp_path: Path, kind: str, said: str
) -> None:
    log = read_log(bag(tmp_path / "bag", lambda m: alternate(m, kind)))
    assert (
        max(
            abs(scan.odometry[0] - 0.1 * i) + abs(scan.odometry[1])
            for i, scan in enumerate(log.scans)
        )
        < 0.01
    )
    assert said in notes(log)


def test_import_reads_several_scan_topics(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = bag(tmp_path / "two", lambda m: two_lasers(m, "/front", "/rear"))
    assert (
        main(
            (
                f"import {path} --set scan_topic=/front --set scan_topic=/none -o {tmp_path / 't'}"
            ).split()
        )
        == 1
    )
    assert "expected a topic of LaserScan, got '/none'" in capsys.readouterr().err
    assert (
        main(
            (
                f"import {path} --set scan_topic=/front --set scan_topic=/rear -o {tmp_path / 't'}"
            ).split()
        )
        == 1
    )
    assert "record at least 90 beams per scan" in capsys.readouterr().err
