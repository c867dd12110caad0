"""A folder of map is one thing: what changes it rewrites its pages, or they say they are old."""

from __future__ import annotations

import json
from pathlib import Path

from ssh_abduction import Trace
from ssh_abduction.cli import main
from ssh_abduction.page.html import ground_in
from ssh_abduction.robot_logs.run_folder import NOTICE, with_notice


def notice(file: Path) -> str:
    found = NOTICE.search(file.read_text())
    return found[0] if found else ""


def test_each_change_reaches_the_page_or_is_said_on_it(house: Path) -> None:
    page, maps = house / "page.html", house / "maps.json"
    steps = len(Trace.load(house / "trace.jsonl"))
    first = ground_in(page, steps)
    assert first is not None
    assert len(first.sections) > 3
    assert notice(page) == ""
    assert main(["name", str(house), "p0", "pantry"]) == 0
    assert "pantry" in page.read_text()
    assert notice(page) == ""
    assert ground_in(page, steps) == first
    assert main(["correct", str(house), "--different", "round:0,round:1"]) == 0
    assert "before the last correction" in notice(page)
    assert main(["name", str(house), "p0", "cellar"]) == 0
    assert "before the last correction" in notice(page)  # still waits for a search
    other = house.parent / "other.html"
    words = ["view", str(house), "--set", "open=false", "-o", str(other)]
    assert main(words) == 0
    assert "before the last correction" in other.read_text()
    before = (house / "recogniser.skops").read_bytes()
    assert main(["solve", str(house), "--theory", "causal", "-o", str(maps)]) == 0
    assert notice(page) == ""
    assert main(words) == 0
    assert "before the last correction" not in other.read_text()
    last = ground_in(page, steps)
    assert last is not None
    assert last.seen == first.seen  # the page keeps its walls, and says whose they are
    assert [section.title for section in last.sections] == ["Summary", "The log"]
    assert "walls are where the map before it put them" in last.sections[0].lines[0]
    assert page.read_text().count("made-before") == 1  # the style
    assert json.loads((house / "run.json").read_text())["theory"]["level"] == "causal"
    assert (house / "recogniser.skops").read_bytes() != before


def test_other_drives_replace_the_trace_of_the_folder(house: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.jsonl"
    Trace.from_steps("aba", ["east", "west"], name="other").save(other)
    maps = str(house / "maps.json")
    assert main(["solve", str(other), "--theory", "causal", "-o", maps]) == 0
    assert len(Trace.load(house / "trace.jsonl")) == 3
    assert not (house / "recogniser.skops").exists()
    assert ground_in(house / "page.html", 3) is None
    assert main(["show", str(house)]) == 0


def test_notice_replaces_an_earlier_one_and_escapes() -> None:
    page = "<body>\n<h1>map</h1>"
    once = with_notice(page, "a < b")
    assert "a &lt; b</p>\n<h1>map" in once
    assert with_notice(once, "c").count("<p ") == 1
    assert with_notice(once, "") == page
