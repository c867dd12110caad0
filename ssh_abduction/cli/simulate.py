"""ssh-abduction simulate, examples and demo: simulated robots, and the package's examples."""

from __future__ import annotations

import argparse
import json
import math
import webbrowser
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ssh_abduction.cli.outcome import EXIT_UNPROVEN
from ssh_abduction.cli.parsing import verb
from ssh_abduction.cli.shared import check_ending, write_trace
from ssh_abduction.cli.text import counted
from ssh_abduction.data.errors import AbductionError, named, printable
from ssh_abduction.data.files import save_file, shipped, write_file

if TYPE_CHECKING:
    from perception.readers.scans import Scan
    from simulator.robot import RecordedDrive

# The formats of logs, by the ending of a file.
FORMATS = {".log": "carmen", ".clf": "carmen", ".bag": "bag", ".mcap": "bag"}
# The world of the demo, a corridor with rooms, and units of work for the search. They suffice for a
# good map, and a demo is short.
WORLD = "doors"
WORK = 5


@verb()
def run_simulate(options: argparse.Namespace) -> int:
    """Drive a robot through a world.

    Write a trace with an image, an action and the odometry at each dstate. Run cluster on the trace
    to get views. With --format, write a log of scans and odometry, as a real robot records it, and
    a file with the truth beside it.
    """
    from simulator.robot import Body
    from simulator.tours import simulate
    from simulator.world import World

    log = Path(options.output.removesuffix(".gz")).suffix.lower()
    options.format = options.format or FORMATS.get(log)
    own = [ending for ending, format in FORMATS.items() if format == options.format]
    check_ending(options.output, *own or [".jsonl"])
    if options.format:
        return _write_log(options, _drive(options))
    if options.world.endswith(".xml"):
        raise AbductionError(
            f"{named(options.world)}: expected --format carmen or --format bag with a floor "
            "plan, as it has no route of actions; add one of them"
        )
    noise = Body.odometry if options.odometry_noise is None else options.odometry_noise
    body = Body(odometry=noise, scale=options.scale_error, bend=math.radians(options.bend_error))
    world = World.named(options.world).with_choices(options.start, options.route, options.reach)
    how: dict[str, Any] = {"stars": options.stars, "every": options.every}
    trace = simulate(world, options.tours, options.seed, body=body, **how)
    write_trace(
        trace, options.output, f"{counted(len(trace), 'images')} of {printable(world.name)}"
    )
    return 0


def _drive(options: argparse.Namespace) -> RecordedDrive:
    """Simulate the drive to write as a robot's log. Raise AbductionError for wrong options."""
    from simulator.plans import Plan
    from simulator.robot import EVERY, Odometer
    from simulator.rounds import record_plan
    from simulator.tours import record
    from simulator.world import World

    for name, given in (("stars=false", not options.stars), ("-o -", options.output == "-")):
        if given:
            raise AbductionError(
                f"{name}: expected no such option with --format, as a robot's log is a file of "
                "scans; leave it out"
            )
    odometer = Odometer(scale=options.scale_error, bend=math.radians(options.bend_error))
    if options.odometry_noise is not None:
        odometer = odometer.as_noisy_as(options.odometry_noise)
    every = EVERY if options.every is None else options.every
    how: dict[str, Any] = {"odometer": odometer, "every": every}
    if not options.world.endswith(".xml"):
        world = World.named(options.world).with_choices(options.start, options.route, options.reach)
        return record(world, options.tours, options.seed, **how)
    for name in ("start", "route", "reach"):
        if getattr(options, name) is not None:
            raise AbductionError(
                f"--{name}: expected no such option with a floor plan, whose rounds are drawn by "
                "--seed; leave it out"
            )
    return record_plan(Plan.load(options.world), options.tours, options.seed, **how)


def _write_log(options: argparse.Namespace, drive: RecordedDrive) -> int:
    """Write a drive as a robot's log, and the truth to a file beside it. Return the exit code."""
    from perception.readers.writers import write_bag, write_carmen

    target = Path(options.output)
    if options.format == "carmen":
        numbers = asdict(drive.odometer).items()
        noise = {f"simulator_odometry_{name}": value for name, value in numbers}
        write_carmen(target, scans_of(drive), noise)
    else:
        write_bag(target, scans_of(drive), drive.odometer.covariances(drive.odometry))
    name = Path(target.name.removesuffix(".gz"))
    truth = target.with_name(f"{name.stem if name.suffix in FORMATS else name}.truth.json")
    save_file(truth, json.dumps(drive.truth).encode() + b"\n", "truth", AbductionError)
    print(
        f"{counted(len(drive), 'scans')} along {drive.metres:.0f} m of {printable(drive.name)} in "
        f"{named(target)}, and the truth in {named(truth)}"
    )
    return 0


def scans_of(drive: RecordedDrive) -> Iterator[Scan]:
    """Yield the scans of a drive. Their corrected poses are the true ones."""
    from perception.readers.scans import LaserScanner, Scan
    from simulator.robot import BEAMS, BEARINGS

    first, step = float(BEARINGS[0]), float(BEARINGS[1] - BEARINGS[0])
    laser = LaserScanner(first, step, BEAMS, drive.laser.reach)
    told = (drive.odometry.tolist(), drive.poses.tolist(), drive.times.tolist())
    rows = zip(drive.ranges, *told, strict=True)
    for line, (ranges, odometry, pose, time) in enumerate(rows, 1):
        yield Scan(ranges, laser, tuple(odometry), tuple(pose), time, line)


@verb()
def run_examples(options: argparse.Namespace) -> int:
    """Copy the examples into a folder.

    Copy the traces, programs and the notebook of the package. If a file of the same name has other
    content, nothing is copied.
    """
    folder = Path(options.output)
    examples = {
        folder / path.name: path.read_bytes()
        for path in sorted(shipped("examples").iterdir())
        if path.is_file()
    }
    for path, data in examples.items():
        if path.exists() and not (path.is_file() and path.read_bytes() == data):
            raise AbductionError(
                f"{named(path)}: expected no file, or the example of this name, got another one; "
                "nothing was copied: move it away, or take another folder (-o FOLDER)"
            )
    folder.mkdir(parents=True, exist_ok=True)
    for path, data in examples.items():
        write_file(path, data)
    listed = ", ".join(path.name for path in examples)
    print(f"{counted(len(examples), 'examples')} in {named(folder)}: {listed}")
    return 0


@verb()
def run_demo(options: argparse.Namespace) -> int:
    """Simulate a drive, map it, and open the map.

    A robot with a laser drives through a simulated building. Its log becomes a map, and the page of
    the map opens in the browser. The commands are printed, to be tried with your own log.
    """
    from ssh_abduction.cli import parser

    folder = Path(options.output)
    log, house = folder / "drive.log", folder / "house"
    folder.mkdir(parents=True, exist_ok=True)
    for words in (
        ["simulate", WORLD, "-o", str(log), "--set", "every=0.5"],
        ["map", str(log), "-o", str(house), "--work-limit", str(WORK)],
    ):
        print(f"$ ssh-abduction {' '.join(words)}", flush=True)
        chosen = parser().parse_args(words)
        if (code := int(chosen.act(chosen))) not in (0, EXIT_UNPROVEN):
            return code
    page = (house / "page.html").absolute()
    print(f"the map: {named(page)}\nnext, try: ssh-abduction show {named(house)} --paths")
    if options.open:
        webbrowser.open(page.as_uri())
    return 0
