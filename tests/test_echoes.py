"""Ranges that hit no wall, and scan matching that contradicts odometry."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from coarse import every_second_beam, hall

from perception.errors import LogError
from perception.places.importing import tracked
from perception.places.odometers import disagreement
from perception.readers.echoes import MEANINGS, Array, LaserOptions, interpret_log, interpreter_of
from perception.readers.logs import read_log
from perception.readers.scans import RobotLog, Scan
from perception.readers.writers import write_bag, write_carmen
from ssh_abduction.cli import main

# Metres beyond which the lasers of these tests see nothing.
SEES = 5.0


@pytest.fixture(scope="module")
def drive() -> tuple[Scan, ...]:
    """A drive around a corner of a hall, with a scan each metre and true ranges."""
    return hall()[:80]


@pytest.fixture(scope="module")
def coarse(drive: tuple[Scan, ...]) -> tuple[Scan, ...]:
    """The beginning of the drive by a laser with half as many beams."""
    return every_second_beam(drive[:64])


def written(
    scans: tuple[Scan, ...],
    say: Callable[[Array, Array], Array],
    reach: float = 12.0,
    nearest: float = 0.0,
) -> list[Scan]:
    """The scans of a laser that sees up to SEES, as a driver writes them.

    Args:
        scans: The scans with true ranges.
        say: Turns ranges, and a mask of those beyond SEES, into what the driver writes.
        reach: Reach that the driver states.
        nearest: Least range that the driver states.
    """
    return [
        replace(
            scan,
            ranges=say(scan.ranges.copy(), scan.ranges > SEES),
            laser=replace(scan.laser, reach=reach, nearest=nearest),
        )
        for scan in scans
    ]


def constant(value: float, noise: float = 0.0) -> Callable[[Array, Array], Array]:
    """A driver that writes a constant where nothing came back."""
    rng = np.random.default_rng(0)
    return lambda ranges, beyond: np.where(
        beyond, value * (1 + noise * rng.uniform(-1, 1, len(ranges))), ranges
    )


def with_rays_beyond(ranges: Array, beyond: Array) -> Array:
    """A driver that writes 5.0, and sometimes something farther."""
    said = np.where(beyond, 5.0, ranges)
    stray = np.flatnonzero(beyond)[::40]
    said[stray] = ranges[stray]
    return said


@pytest.mark.parametrize(
    ("say", "reach"),
    [
        (constant(5.0), 12.0),
        (constant(5.0), math.inf),
        (constant(5.09), 12.0),
        (constant(8.0), 12.0),
        (constant(float(np.float32(5.1))), 12.0),
        (constant(5.05, noise=0.0005), 30.0),
        (constant(5.2, noise=0.01), 12.0),
        (with_rays_beyond, 12.0),
    ],
)
def test_repeating_range_counts_as_no_return(
    drive: tuple[Scan, ...], say: Callable[[Array, Array], Array], reach: float
) -> None:
    scans, notes = interpret_log(written(drive, say, reach), LaserOptions())
    assert len(notes) == 1
    assert re.search(
        (
            r"Ranges of \d\.?\d* m repeat in \d+ % of the beams, and hardly any are longer.*--set "
            r"no_return"
        ),
        notes[0],
    )
    for scan, true in zip(scans, drive, strict=True):
        assert np.array_equal(np.isinf(scan.ranges), true.ranges > SEES)


@pytest.mark.parametrize(
    ("say", "reach"),
    [
        (lambda ranges, _: np.minimum(ranges, 8.0), 8.0),  # The reach itself is not worth a note.
        (lambda ranges, beyond: np.where(beyond, np.inf, ranges), 12.0),
        (lambda ranges, _: ranges, 8.0),
    ],
)
def test_ranges_of_walls_are_kept_without_a_note(
    drive: tuple[Scan, ...], say: Callable[[Array, Array], Array], reach: float
) -> None:
    scans, notes = interpret_log(written(drive, say, reach), LaserOptions())
    assert notes == ()
    for scan, true in zip(scans, drive, strict=True):
        seen = np.isfinite(scan.ranges)
        assert np.array_equal(scan.ranges[seen], true.ranges[seen])
        assert (true.ranges[~seen] >= SEES).all()


def test_standing_before_a_wall_gives_no_note_about_repeats(
    drive: tuple[Scan, ...],
) -> None:
    flat = replace(drive[0], ranges=np.full(180, 2.0))
    assert not any("repeat" in note for note in interpret_log([flat] * 200, LaserOptions())[1])


def test_invalid_reach_becomes_the_largest_range(drive: tuple[Scan, ...]) -> None:
    scans, notes = interpret_log(
        written(drive, lambda ranges, beyond: np.where(beyond, np.inf, ranges), math.inf),
        LaserOptions(),
    )
    most = max(scan.ranges[scan.ranges <= SEES].max() for scan in drive)
    assert re.search(rf"does not say how far the laser reaches.* it is {most:.4g} m", notes[0])
    assert all(
        np.isfinite(scan.ranges[true.ranges <= SEES]).all()
        for scan, true in zip(scans, drive, strict=True)
    )


@pytest.mark.parametrize("value", [0.0, math.nan, -1.0, 0.05])
def test_zeros_where_no_walls_are_seen_are_free(drive: tuple[Scan, ...], value: float) -> None:
    scans, notes = interpret_log(written(drive, constant(value), nearest=0.1), LaserOptions())
    assert re.search(r"\d+ % of the beams are .*nothing came back.*--set zero_is=unknown", notes[0])
    for scan, true in zip(scans, drive, strict=True):
        assert np.array_equal(np.isinf(scan.ranges), true.ranges > SEES)


@pytest.mark.parametrize("value", [0.0, math.nan])
def test_zeros_at_random_are_unknown(drive: tuple[Scan, ...], value: float) -> None:
    rng = np.random.default_rng(0)
    scans, notes = interpret_log(
        written(drive, lambda ranges, _: np.where(rng.random(len(ranges)) < 0.1, value, ranges)),
        LaserOptions(),
    )
    (note,) = (note for note in notes if "of the beams are" in note)
    assert re.search(r"\d+ % of the beams are .*nothing is known there.*--set zero_is=free", note)
    assert all(np.isnan(scan.ranges).any() for scan in scans)


def test_zeros_at_far_walls_are_unknown(drive: tuple[Scan, ...]) -> None:
    """A weak laser often fails at walls beyond 4 m. The beams beside its zeros are long, too."""
    rng = np.random.default_rng(1)

    def fails(ranges: Array, _: Array) -> Array:
        return np.where((ranges > 4) & (rng.random(len(ranges)) < 0.6), 0.0, ranges)

    logged = written(drive, fails, 30.0)
    scans, notes = interpret_log(logged, LaserOptions())
    assert any(re.search(r"beams are 0\. .*nothing is known there", note) for note in notes)
    zeros = [scan.ranges[raw.ranges == 0] for scan, raw in zip(scans, logged, strict=True)]
    assert np.isnan(np.concatenate(zeros)).all()


def test_zeros_of_a_blind_sector_are_unknown(drive: tuple[Scan, ...]) -> None:
    """Where a mast hides all walls, no scan from nearby sees one either."""

    def blind(ranges: Array, _: Array) -> Array:
        ranges[80:110] = 0.0
        return ranges

    scans, notes = interpret_log(written(drive, blind, 30.0), LaserOptions())
    assert any("of the beams are 0. No scan from nearby shows" in note for note in notes)
    assert np.isnan(np.stack([scan.ranges[80:110] for scan in scans])).all()


@pytest.mark.parametrize("meaning", MEANINGS)
def test_zero_is_setting_is_obeyed_without_a_note(drive: tuple[Scan, ...], meaning: str) -> None:
    told = LaserOptions(zero_is=meaning, no_return=11.0)
    scans, notes = interpret_log(written(drive, constant(0.0)), told)
    assert notes == ()
    alone_of, _ = interpreter_of([], told)
    is_meant = np.isinf if meaning == "free" else np.isnan
    for scan, alone, true in zip(
        scans, map(alone_of, written(drive, constant(0.0))), drive, strict=True
    ):
        assert is_meant(scan.ranges[true.ranges > SEES]).all()
        assert np.array_equal(scan.ranges, alone.ranges, equal_nan=True)


def test_ranges_of_at_least_no_return_are_infinite(drive: tuple[Scan, ...]) -> None:
    scans, _ = interpret_log(drive, LaserOptions(no_return=3.0))
    assert all(
        np.array_equal(np.isinf(scan.ranges), true.ranges >= 3.0)
        for scan, true in zip(scans, drive, strict=True)
    )


@pytest.mark.parametrize(
    "told",
    [
        {"fov": 0},
        {"fov": 361},
        {"fov": math.nan},
        {"fov": "180"},
        {"mount": (1, 2)},
        {"mount": (1, 2, math.inf)},
        {"mount": (1000, 0, 0)},
        {"mount": "0,0,0"},
        {"no_return": 0},
        {"no_return": -1},
        {"no_return": math.inf},
        {"zero_is": "wall"},
        {"zero_is": 0},
    ],
)
def test_invalid_laser_options_are_refused(told: dict[str, object]) -> None:
    with pytest.raises(LogError, match=f"{next(iter(told))}: expected .*, got .*; name"):
        LaserOptions(**told)  # type: ignore[arg-type]


def test_one_mount_for_several_lasers_is_refused(drive: tuple[Scan, ...]) -> None:
    second = [replace(scan, laser=replace(scan.laser, mount=(0.0, 0.0, math.pi))) for scan in drive]
    with pytest.raises(LogError, match="mount: expected the scans of one laser, got those of 2"):
        interpret_log([*drive, *second], LaserOptions(mount=(0, 0, 0)))


def doubt(scans: tuple[Scan, ...]) -> str:
    log = RobotLog(scans, source="drive")
    log, track, notes = tracked(log)
    assert sum("Scan matching and odometry" in note for note in notes) <= 1
    return disagreement(log, track) or ""


def test_good_drive_gets_no_laser_warning(coarse: tuple[Scan, ...]) -> None:
    assert doubt(coarse) == ""


@pytest.mark.parametrize("fov", [120.0, pytest.param(270.0, marks=pytest.mark.slow)])
def test_warning_names_the_likely_field_of_view(coarse: tuple[Scan, ...], fov: float) -> None:
    """The true one is 180 degrees."""
    said = doubt(tuple(LaserOptions(fov=fov).placed(scan) for scan in coarse))
    (about,) = map(
        float, re.findall(rf"cover about (\d+) degrees, not {fov:.0f} \(--set fov\)", said)
    )
    assert about == pytest.approx(180, abs=5)
    assert re.search(r"\d+ m by scans, \d+ m by odometry; turns by scans are \d\.\d\d times", said)


@pytest.mark.slow
def test_warning_names_a_laser_that_hangs_upside_down(coarse: tuple[Scan, ...]) -> None:
    assert "--set fov=180" in doubt(tuple(LaserOptions(fov=-180).placed(scan) for scan in coarse))


@pytest.mark.slow
def test_warning_names_the_likely_mount(coarse: tuple[Scan, ...]) -> None:
    """The laser truly looks ahead."""
    said = doubt(tuple(LaserOptions(mount=(0, 0, 60.0)).placed(scan) for scan in coarse))
    (looks,) = map(float, re.findall(r"--set mount=0,0,(-?\d+)\)", said))
    assert abs(looks) <= 10


@pytest.mark.slow
def test_no_laser_warning_if_the_odometer_explains_it(coarse: tuple[Scan, ...]) -> None:
    """Odometry in a wrong unit, or none, already explains the disagreement."""
    lost = tuple(replace(scan, odometry=(0.0, 0.0, 0.0)) for scan in coarse)
    _, _, notes = tracked(RobotLog(lost, source="drive"))
    assert any("The odometry stands still in" in note for note in notes)
    assert not any("Scan matching and odometry" in note for note in notes)


@pytest.mark.parametrize("verb", ["import", "map"])
def test_import_and_map_share_notes_and_options(
    coarse: tuple[Scan, ...], verb: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "dri\x1b[31mve.bag"  # A name that would colour a terminal.
    write_bag(
        path, written(tuple(LaserOptions(fov=135).placed(scan) for scan in coarse), constant(5.0))
    )
    out = [
        "-o",
        str(tmp_path / "out"),
        *(["--time-limit", "1"] if verb == "map" else []),
    ]
    main([verb, str(path), *out])
    said = capsys.readouterr().err
    for note in (
        "Ranges of 5 m repeat",
        "Scan matching and odometry disagree",
    ):
        assert said.count(f"warning: {note}") == 1
    assert "Scans come from" not in said  # it is no warning, but the report has it
    if verb == "map":
        for file in ("run.json", "page.html"):
            text = (tmp_path / "out" / file).read_text()
            assert "Scans come from /scan, odometry from /odom." in text
            assert "Ranges of 5 m repeat" in text
            assert "Scan matching and odometry disagree" in text
            assert "\x1b" not in text
    else:
        settings = "fov=180", "no_return=5", "mount=0,0,0", "zero_is=unknown"
        main([verb, str(path), *out, *(f"--set={setting}" for setting in settings)])
        said = capsys.readouterr().err
        assert "repeat" not in said
        assert "Scan matching and odometry" not in said


def test_note_if_a_log_lacks_the_field_of_view(drive: tuple[Scan, ...], tmp_path: Path) -> None:
    """FLASER lines have no field of view; conventions cover 180 and 181 beams, not 150."""
    for beams, is_noted in ((180, False), (150, True)):
        path = tmp_path / "drive.log"
        few = [
            replace(scan, ranges=scan.ranges[:beams], laser=replace(scan.laser, beams=beams))
            for scan in drive
        ]
        lines = [
            f"FLASER {beams} {' '.join(f'{min(r, 81.0):.2f}' for r in s.ranges)} 0 0 0 "
            f"{' '.join(map(str, s.odometry))} {t} x {t}"
            for t, s in enumerate(few)
        ]
        path.write_text("\n".join(lines) + "\n")
        for told, here in ({}, is_noted), ({"fov": 150.0}, False):
            assert any("--set fov" in note for note in read_log(path, **told).notes) == here  # type: ignore[arg-type]
    assert read_log(path, fov=90).scans[0].laser.step * 150 == pytest.approx(math.pi / 2)
    write_carmen(path, drive)
    assert not any("--set fov" in note for note in read_log(path).notes)


@pytest.mark.parametrize(
    "words",
    [
        ["--set", "fov=0"],
        ["--set", "fov=x"],
        ["--set", "mount=1,2"],
        ["--set", "no_return=-1"],
        ["--set", "zero_is=wall"],
        ["--set=mount=1,2,nan"],
    ],
)
def test_invalid_laser_settings_are_refused_in_the_shell(
    words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as end:
        main(["import", "drive.log", *words])
    assert end.value.code == 2
    assert "expected" in (said := capsys.readouterr().err) or "invalid choice" in said


@pytest.mark.parametrize("measured", [0, 4])
def test_scans_without_measurements_are_counted_in_the_note(
    coarse: tuple[Scan, ...], measured: int
) -> None:
    unseen = [replace(scan, ranges=np.full_like(scan.ranges, np.nan)) for scan in coarse[measured:]]
    _, notes = interpret_log([*coarse[:measured], *unseen], LaserOptions())
    (note,) = (note for note in notes if "of the beams are NaN" in note)
    assert " 0 m" not in note
    assert ("no beam measured anything" in note) == (measured == 0)
