"""ssh-abduction live: map a building while the robot drives, from ROS 2 or from a log."""

from __future__ import annotations

import argparse
import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from ssh_abduction.cli import import_log
from ssh_abduction.cli.outcome import StopFlag, on_ctrl_c, warn
from ssh_abduction.cli.parsing import RUN, verb
from ssh_abduction.cli.text import counted
from ssh_abduction.data.errors import AbductionError, named
from ssh_abduction.runtime.loggers import begin_stage, log_progress, stages

if TYPE_CHECKING:
    from ssh_abduction.robot_logs.log_mapper import LiveSession, OnlineLogMapper

# A pause of the robot in a log is replayed for at most this many seconds.
PAUSE = 1.0
say = partial(print, flush=True)


def positive(text: str) -> float:
    """Convert text to a positive number. Raise ArgumentTypeError for anything else."""
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"expected a positive number, got {text!r}")
    return value


@verb(
    {
        "--speed": {"type": positive},
        "--ros-args": {"nargs": argparse.REMAINDER, "default": []},
        "idle": {"type": positive},
        "--page": {"type": int},
        "--work-limit": {"type": positive, "default": 5.0},
    },
    READING=import_log.READING,
)
def run_live(options: argparse.Namespace) -> int:
    """Map a building while the robot drives.

    Take laser scans one at a time. Say when a place is new, moved, or joined with another one.
    Another process searches for the map.
    """
    from perception.errors import LogError
    from ssh_abduction.robot_logs.log_mapper import LiveSession, OnlineLogMapper

    where = options.save if options.save is not None else options.onto
    folder = None if where is None else Path(where)
    if folder is not None and (folder / RUN).exists():
        raise AbductionError(
            f"{named(folder)}: expected a new folder, or one that live saved to, got one that map "
            "wrote; name another folder"
        )
    if folder is not None and options.replay is not None:
        import_log.check_run_folder(folder)
    tell = lambda note: warn([note])  # noqa: E731
    mapper = OnlineLogMapper(options.width or import_log.WIDTH, tell)
    if options.onto is not None:
        mapper = OnlineLogMapper.load(options.onto, tell)
        mapper.lift()
    elif folder is not None and OnlineLogMapper.is_saved(folder):
        try:
            mapper = OnlineLogMapper.load(folder, tell)
            print(f"{named(folder)}: the drive goes on after {counted(len(mapper), 'scans')}")
        except LogError as error:  # a robot that drives should not stop for this
            warn([f"{error}; the map is kept in memory, and not saved"])
            folder = None
    session = LiveSession(mapper, folder, say, options.work_limit)
    if options.page is not None:
        from ssh_abduction.robot_logs.live_page import LivePage

        print(f"page: {LivePage(options.page, session).url}", flush=True)
    if options.replay is None:
        _listen(options, session)
    else:
        with stages("log", "drive", "last map"):
            _replay(options, session)
    _say_map(session.mapper)
    return 0


def _listen(options: argparse.Namespace, session: LiveSession) -> None:
    """Give the scans that ROS 2 brings to a session."""
    from ssh_abduction.robot_logs.log_mapper import OnlineLogMapper
    from ssh_abduction.robot_logs.ros_node import NodeOptions, run_node

    width, tell = options.width or import_log.WIDTH, session.mapper.live.tell.to
    given = NodeOptions(
        options.scan, options.odom, options.mount, idle=options.idle, ros_args=options.ros_args
    )

    # The first Ctrl-C or SIGTERM ends the drive, the second one the last search.
    stop = StopFlag()
    with on_ctrl_c(stop.ask):
        run_node(session, lambda: OnlineLogMapper(width, tell), given, say, stop.is_set)
        with stages("last map"):
            session.end()


def _replay(options: argparse.Namespace, session: LiveSession) -> None:
    log = import_log.read(options.replay, options)
    for warning in log.warnings:
        warn([warning])
    due, last = time.monotonic(), None
    known = 0 if options.onto is not None else len(session.mapper)
    begin_stage("drive")
    with import_log.until_ctrl_c(iter(log.scans[known:]), StopFlag()) as scans:
        for k, scan in enumerate(scans, known):
            log_progress(f"{k} of {len(log)} scans")
            if options.speed and last is not None and scan.time is not None:
                due += min(max(scan.time - last, 0.0), PAUSE) / options.speed
                time.sleep(max(0.0, due - time.monotonic()))
            last = scan.time
            session.take(scan)
            session.tick()
        begin_stage("last map")
        session.end()


def _say_map(mapper: OnlineLogMapper) -> None:
    """Print the places of the last map."""
    found = mapper.to_dict()
    for place in found["places"]:
        name = f" ({place['name']})" if place["name"] else ""
        print(f"place {place['place']}{name} at ({place['x']:.1f}, {place['y']:.1f}) m")
    places = counted(len(found["places"]), "places")
    visits = counted(sum(len(place["scans"]) for place in found["places"]), "visits")
    print(f"{places} after {counted(found['scans'], 'scans')} and {visits}: {found['said']}")
