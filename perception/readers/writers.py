"""Writes scans with odometry, such as those of a simulated robot, as logs of real robots.

>>> import math, tempfile
>>> import numpy as np
>>> from perception.readers.logs import read_log
>>> from perception.readers.scans import LaserScanner, Scan
>>> from perception.readers.writers import write_carmen
>>> laser = LaserScanner(first=-math.pi / 2, step=math.pi / 2, beams=3, reach=8.0)
>>> ranges, odometry, corrected = np.array([1.0, np.inf, 2.5]), (1.0, 0.0, 0.0), (1.1, 0.0, 0.0)
>>> scan = Scan(ranges, laser, odometry, corrected, time=0.5)
>>> with tempfile.TemporaryDirectory() as folder:
...     write_carmen(f"{folder}/drive.log", [scan])
...     read = read_log(f"{folder}/drive.log").scans[0]
>>> read.ranges.tolist(), read.odometry, read.corrected
([1.0, inf, 2.5], (1.0, 0.0, 0.0), (1.1, 0.0, 0.0))

Lengths are metres and angles radians in all formats. The true pose, `corrected`, is written in
lines or transforms of its own, so that readers do not take it for odometry. A scan without a time
gets its index as time in seconds.
"""

from __future__ import annotations

import gzip
import math
import os
import shutil
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from perception.errors import LogError
from perception.readers.bag_files import TRANSFORMS, typestore
from perception.readers.scans import Array, LaserScanner, Scan
from ssh_abduction.data.checks import needed
from ssh_abduction.data.errors import named
from ssh_abduction.data.files import save_file
from ssh_abduction.data.odometry import Pose, displacement_between, moved

HEADER = (
    "# message formats defined: PARAM ODOM TRUEPOS ROBOTLASER1\n"
    "# ODOM x y theta tv rv accel timestamp hostname logger_timestamp\n"
    "# TRUEPOS true_x true_y true_theta odom_x odom_y odom_theta timestamp hostname "
    "logger_timestamp\n"
    "# ROBOTLASER1 type start fov step reach accuracy remission n ranges 0 laser_pose robot_pose "
    "tv rv forward side axis timestamp hostname logger_timestamp\n"
)
# Frames of a bag, named as in REP 105.
MAP, ODOM, BASE, LASER = "map", "odom", "base_link", "laser"
NANO = 1_000_000_000
# Positions of x, y and the rotation about z in a covariance of ROS.
PLANAR = (0, 1, 5)


def write_carmen(
    path: str | os.PathLike[str],
    scans: Iterable[Scan],
    parameters: Mapping[str, float] | None = None,
) -> None:
    """Write scans as a log of CARMEN, completely or not at all.

    Each scan has up to three lines, as CARMEN's simulator writes them: a TRUEPOS line if the true
    pose is known, an ODOM line, and a ROBOTLASER1 line with ranges, geometry and mount of the
    laser. Ranges beyond the reach are written as the reach, ranges that are no measurement as 0.

    Args:
        scans: The scans, in the order of the log.
        path: The file; it is gzipped if its name ends in .gz.
        parameters: Numbers by name, such as the noise of the odometry. They are written in PARAM
            lines at the beginning.

    Raises:
        LogError: There is no scan, or the file cannot be written.
    """
    head = HEADER + "".join(
        f"PARAM {name} {value:g} 0 localhost 0\n" for name, value in (parameters or {}).items()
    )
    text = head + "".join(map(_carmen_lines, *_numbered(scans)))
    data = text.encode("ascii")
    packed = gzip.compress(data, mtime=0) if os.fspath(path).endswith(".gz") else data
    save_file(path, packed, "log", LogError)


def write_bag(
    path: str | os.PathLike[str], scans: Iterable[Scan], covariances: Array | None = None
) -> None:
    """Write scans as a ROS bag, completely or not at all.

    The topics are /scan (LaserScan), /odom (Odometry), /tf (from odom to base_link and, if the true
    poses are known, from map to odom) and /tf_static (from base_link to laser).

    Args:
        scans: The scans, in the order of the log.
        path: File or folder to write. A name that ends in .bag makes a file of ROS 1, one in .mcap
            a file of MCAP, and any other a folder of ROS 2.
        covariances: (n, 3, 3) covariance of the pose by odometry (x, y, heading) at each scan. None
            writes zeros, which mean unknown.

    Raises:
        LogError: There is no scan, the folder exists, the bag cannot be written, or the extra `ros`
            is missing.
    """
    target = Path(path)
    if target.is_dir():
        raise LogError(
            f"{named(path)}: expected the name of a new folder, got an existing folder; name "
            "another, or remove it"
        )
    try:
        with tempfile.TemporaryDirectory(dir=target.parent, prefix=".bag-") as draft:
            written = _write_bag(Path(draft) / target.name, scans, covariances)
            if target.is_file() and written.is_dir():
                raise LogError(
                    f"{named(path)}: expected the name of a folder, got that of a file; name "
                    "another, or end it in .bag or .mcap"
                )
            shutil.move(written, target)
    except LogError:
        raise
    except OSError as error:
        raise LogError(
            f"{named(path)}: expected a bag that can be written: {error.strerror or error}; "
            "check the path"
        ) from None
    except Exception as error:  # rosbags writes with SQLite, which raises errors of its own.
        raise LogError(
            f"{named(path)}: expected a bag that can be written: {error}; check the disk and "
            "the path"
        ) from None


def _numbered(scans: Iterable[Scan]) -> tuple[list[Scan], list[float]]:
    """List the scans, and the time of each in seconds. Raises LogError if there are no scans."""
    listed = list(scans)
    if not listed:
        raise LogError("scans: expected at least one to write, got none; record some first")
    return listed, [float(i) if scan.time is None else scan.time for i, scan in enumerate(listed)]


def _carmen_lines(scan: Scan, time: float) -> str:
    """The lines of a scan in a log of CARMEN."""
    stamp = f"{time:.6f} localhost {time:.6f}\n"
    odometry = _numbers(scan.odometry)
    laser = scan.laser
    # CARMEN has no infinity: an unknown reach lies just beyond all ranges.
    reach = (
        laser.reach
        if math.isfinite(laser.reach)
        else float(np.max(scan.ranges, where=np.isfinite(scan.ranges), initial=0.0)) + 1.0
    )
    ranges = " ".join(f"{r:.4f}" for r in np.nan_to_num(np.minimum(scan.ranges, reach), nan=0.0))
    shape = f"{laser.first:.9f} {laser.step * laser.beams:.9f} {laser.step:.9f} {reach:.4f} 0.01 0"
    truth = (
        f"TRUEPOS {_numbers(scan.corrected)} {odometry} {stamp}"
        if scan.corrected is not None
        else ""
    )
    return (
        f"{truth}ODOM {odometry} 0 0 0 {stamp}"
        f"ROBOTLASER1 0 {shape} {laser.beams} {ranges} 0 "
        f"{_numbers(moved(scan.odometry, laser.mount))} {odometry} 0 0 0 0 0 {stamp}"
    )


def _numbers(pose: Pose) -> str:
    return " ".join(f"{value:.6f}" for value in pose)


def _write_bag(path: Path, scans: Iterable[Scan], covariances: Array | None) -> Path:
    """Write a bag to a new path; return the file or folder that is the result."""
    with needed("bag", "rosbags", "'.[ros]' in your clone", LogError):
        from rosbags import rosbag1, rosbag2
    is_ros1 = path.suffix == ".bag"
    store = typestore(is_ros1)
    kinds = {
        "/scan": "sensor_msgs/msg/LaserScan",
        "/odom": "nav_msgs/msg/Odometry",
        "/tf": TRANSFORMS[0],
        "/tf_static": TRANSFORMS[0],
    }
    plugin = rosbag2.StoragePlugin.MCAP if path.suffix == ".mcap" else rosbag2.StoragePlugin.SQLITE3
    writer: Any = (
        rosbag1.Writer(path) if is_ros1 else rosbag2.Writer(path, version=8, storage_plugin=plugin)
    )
    serialize = store.serialize_ros1 if is_ros1 else store.serialize_cdr
    with writer:
        topics = {
            topic: writer.add_connection(topic, kind, typestore=store)
            for topic, kind in kinds.items()
        }
        for topic, time, message in _messages(store, scans, covariances, is_ros1):
            writer.write(topics[topic], time, serialize(message, kinds[topic]))
    return next(path.glob("*.mcap")) if path.suffix == ".mcap" else path


def _messages(
    store: Any, scans: Iterable[Scan], covariances: Array | None, is_ros1: bool
) -> Iterator[tuple[str, int, Any]]:
    """Yield topic, time in nanoseconds and message of all scans, or raise LogError."""
    types = store.types
    mounted: set[Pose] = set()
    for number, (scan, seconds) in enumerate(zip(*_numbered(scans), strict=True)):
        time = round(seconds * NANO)
        if time < 0:
            raise LogError(
                f"scan {number}: expected a time from 0 on, as bags count it, got "
                f"{seconds:g}; shift the times"
            )
        stamp = types["builtin_interfaces/msg/Time"](sec=time // NANO, nanosec=time % NANO)
        make = _Maker(types, stamp, {"seq": number} if is_ros1 else {})
        laser = scan.laser
        # The mount of the laser is static: it is written once.
        if laser.mount not in mounted:
            if mounted:
                raise LogError(
                    f"scan {number}: expected the laser where it was mounted before, got another "
                    "mount; write two bags"
                )
            mounted.add(laser.mount)
            yield "/tf_static", time, make.transform(BASE, LASER, laser.mount)
        yield "/tf", time, make.transform(ODOM, BASE, scan.odometry)
        if scan.corrected is not None:
            back = displacement_between(scan.odometry, (0.0, 0.0, 0.0))
            yield "/tf", time, make.transform(MAP, ODOM, moved(scan.corrected, back))
        covariance = np.zeros((3, 3)) if covariances is None else covariances[number]
        yield "/odom", time, make.odometry(scan.odometry, covariance)
        yield "/scan", time, make.scan(scan.ranges, laser)


class _Maker:
    """Makes messages with one time. ROS 1 also numbers headers."""

    def __init__(self, types: Any, stamp: Any, numbering: dict[str, int]) -> None:
        self.types, self.stamp, self.numbering = types, stamp, numbering

    def header(self, frame: str) -> Any:
        """Make the header of a message in a frame."""
        return self.types["std_msgs/msg/Header"](stamp=self.stamp, frame_id=frame, **self.numbering)

    def transform(self, parent: str, child: str, pose: Pose) -> Any:
        """Make a TFMessage with one transform, which is the pose of the child in its parent."""
        geometry = "geometry_msgs/msg/"
        move = self.types[geometry + "Transform"](
            translation=self.vector(pose[0], pose[1]), rotation=self.turned(pose[2])
        )
        stamped = self.types[geometry + "TransformStamped"](
            header=self.header(parent), child_frame_id=child, transform=move
        )
        return self.types["tf2_msgs/msg/TFMessage"](transforms=[stamped])

    def odometry(self, pose: Pose, covariance: Array) -> Any:
        """Make an Odometry message of a pose with a (3, 3) covariance."""
        geometry, unknown = "geometry_msgs/msg/", np.zeros(36)
        # ROS has six dimensions; only three (plane) are known.
        known = np.zeros((6, 6))
        known[np.ix_(PLANAR, PLANAR)] = covariance
        at = self.types[geometry + "Pose"](
            position=self.types[geometry + "Point"](x=pose[0], y=pose[1], z=0.0),
            orientation=self.turned(pose[2]),
        )
        still = self.types[geometry + "Twist"](
            linear=self.vector(0.0, 0.0), angular=self.vector(0.0, 0.0)
        )
        return self.types["nav_msgs/msg/Odometry"](
            header=self.header(ODOM),
            child_frame_id=BASE,
            pose=self.types[geometry + "PoseWithCovariance"](pose=at, covariance=known.ravel()),
            twist=self.types[geometry + "TwistWithCovariance"](twist=still, covariance=unknown),
        )

    def scan(self, ranges: Array, laser: LaserScanner) -> Any:
        """Make a LaserScan message with ranges in metres."""
        return self.types["sensor_msgs/msg/LaserScan"](
            header=self.header(LASER),
            angle_min=laser.first,
            angle_max=laser.first + laser.step * (laser.beams - 1),
            angle_increment=laser.step,
            time_increment=0.0,
            scan_time=0.0,
            range_min=laser.nearest,
            range_max=laser.reach,
            ranges=np.asarray(ranges, dtype=np.float32),
            intensities=np.zeros(0, dtype=np.float32),
        )

    def vector(self, x: float, y: float) -> Any:
        """Make a vector in the plane."""
        return self.types["geometry_msgs/msg/Vector3"](x=x, y=y, z=0.0)

    def turned(self, angle: float) -> Any:
        """Make the quaternion of a rotation about z by an angle in radians."""
        return self.types["geometry_msgs/msg/Quaternion"](
            x=0.0, y=0.0, z=math.sin(angle / 2), w=math.cos(angle / 2)
        )
