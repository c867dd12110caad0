"""Read trace files. They have JSON lines: a header, then one line for each step.

See docs/reference/formats.md.
"""

from __future__ import annotations

import codecs
from collections.abc import Mapping
from dataclasses import fields
from typing import Any, BinaryIO

from ssh_abduction.data.action import Action, parse_action
from ssh_abduction.data.checks import a_text
from ssh_abduction.data.errors import TraceError, brief, said_of
from ssh_abduction.data.files import LINE_OF_A_LOG, BadJson, parse_json
from ssh_abduction.data.odometry import Odometry, parse_closures
from ssh_abduction.data.step import Step

FORMAT, VERSION = "ssh-trace", 1
# The most bytes of a line. An image of 100,000 numbers fits into a line. A file without line ends
# is rejected before it fills the memory.
LONGEST_LINE = 16 * 2**20
# How files of maps and robots' logs begin. Users sometimes give these files instead of a trace.
_MAPS = (b'{"format": "ssh-solution"', b'{"format": "ssh-map"')
_LOGS = {
    b"\x1f\x8b": "gzipped data",
    b"#ROSBAG V": "a bag of ROS 1",
    b"SQLite format 3\0": "a bag of ROS 2",
    b"\x89MCAP0": "MCAP",
    b"# message formats defined": "a log of CARMEN",
}
_STEP_FIELDS = tuple(f.name for f in fields(Step) if f.name not in ("extra", "gateways"))
_HEADER_FIELDS = ("format", "version", "name", "images", "odometry", "drive", "closures")


def read_trace(file: BinaryIO, source: str) -> dict[str, Any]:
    """Return the arguments of Trace, by name, from a trace file.

    Raises TraceError, which names the file, the line and the field.
    """
    header: dict[str, Any] | None = None
    steps: list[Step] = []
    actions: dict[str, Action] = {}
    empty_line = number = 0
    while raw := file.readline(LONGEST_LINE + 1):
        number += 1
        where = f"{source}:{number}"
        if len(raw) > LONGEST_LINE:
            raise TraceError(
                f"{where}: line: expected at most {LONGEST_LINE // 2**20} MiB, got more; "
                f"write one step per line, and big images to a sidecar file"
            )
        if not raw.strip():  # empty lines are allowed at the end only
            empty_line = empty_line or number
            continue
        if empty_line:
            raise TraceError(
                f"{source}:{empty_line}: line: expected a step, got an empty line; remove it"
            )
        record = _record(raw, where)
        if header is None:
            header = _header(record, where)
        else:
            steps.append(_step(record, where, actions))
    if header is None:
        raise TraceError(
            f'{source}:1: header: expected {{"format": "{FORMAT}", "version": {VERSION}}}, '
            f"got an empty file; write the header, then a line per step"
        )
    return {
        "steps": tuple(steps),
        **{name: header.get(name) for name in ("name", "images", "odometry", "drive")},
        "closures": header["closures"],
        "extra": {k: v for k, v in header.items() if k not in _HEADER_FIELDS},
    }


def _record(raw: bytes, where: str) -> dict[str, Any]:
    """Parse a line and return its object. The first line may begin with a byte order mark."""
    if where.endswith(":1"):
        _refuse_other_files(raw, where)
        raw = raw.removeprefix(codecs.BOM_UTF8)
    try:
        record = parse_json(raw.rstrip())
    except BadJson as error:
        what = f"{where}: {error.field or 'line'}: expected {error.expected}, got {error}"
        raise TraceError(f"{what}; {error.mend or 'correct this line'}") from None
    if not isinstance(record, dict):
        raise TraceError(
            f"{where}: line: expected a JSON object in braces, got {brief(record)}; "
            f"write one step per line"
        )
    return record


def _refuse_other_files(raw: bytes, where: str) -> None:
    """Raise TraceError if the first line is that of a robot's log or of a file of maps."""
    log = next((kind for magic, kind in _LOGS.items() if raw.startswith(magic)), None)
    if log is None and LINE_OF_A_LOG.match(raw):
        log = "lines of CARMEN or g2o"
    if log:
        raise TraceError(
            f"{where}: header: expected a trace, got {log}, as robots' logs are; "
            f"make a trace of it with ssh-abduction import LOG -o trace.jsonl"
        )
    if raw.startswith(_MAPS):
        raise TraceError(
            f"{where}: header: expected a trace, got maps, as solve prints them; "
            f"name the two files in the other order, or solve's trace"
        )


def _header(record: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Check the header and return it as a dict, its odometry and closures as objects."""
    if record.get("format") != FORMAT:
        came = f"a line without it: {brief(dict(record))}"
        came = brief(record["format"]) if "format" in record else came
        raise TraceError(
            f'{where}: format: expected "{FORMAT}" in a header, got {came}; '
            f'put {{"format": "{FORMAT}", "version": {VERSION}}} on the first line'
        )
    version = record.get("version")  # True equals 1, so also check the type
    if version != VERSION or isinstance(version, bool):
        raise TraceError(
            f"{where}: version: expected {VERSION}, got {brief(version)}; "
            f"convert the file, or take a newer ssh-abduction"
        )
    odometry = record.get("odometry")
    with said_of(where):
        for key in ("name", "images", "drive"):
            if record.get(key) is not None:
                a_text(key, record[key], TraceError, mend="quote it or leave it out")
        return {
            **record,
            "odometry": None if odometry is None else Odometry.of(odometry),
            "closures": parse_closures(record.get("closures")),
        }


def _step(record: Mapping[str, Any], where: str, actions: dict[str, Action]) -> Step:
    """Make a step from the object on a line. Equal actions become one object, kept in `actions`."""
    given = {name: record.get(name) for name in _STEP_FIELDS}
    if given["image"] is None and "view" not in record:
        raise TraceError(
            f"{where}: view: expected a text or an integer (or an image to make one from), "
            f"got none; say what the robot saw, or null where that was not logged"
        )
    if given["action"] is not None:
        action = parse_action(given["action"], f"{where}: action")
        known = action if action.extra else actions.setdefault(action.name, action)
        given["action"] = known if known == action else action
    with said_of(where):
        return Step(**given, extra={k: v for k, v in record.items() if k not in _STEP_FIELDS})
