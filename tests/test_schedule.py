"""The schedule of a search: one table, which the documentation shows."""

from __future__ import annotations

import math
import re
from pathlib import Path

import pytest
from schedule_table import PAGE, page
from turns import turn_with

import ssh_abduction.solver
from ssh_abduction.runtime.limits import Watch
from ssh_abduction.solver.costs.beams import WIDTHS
from ssh_abduction.solver.schedule import TABLE, TURNS, turn

SOLVER = Path(ssh_abduction.solver.__file__).parent


def test_page_shows_the_schedule() -> None:
    assert PAGE.read_text(encoding="utf-8") == page(), "run python website/schedule_table.py"


def test_each_turn_is_used_by_the_solver() -> None:
    code = "".join(p.read_text() for p in SOLVER.rglob("*.py") if p.name != "schedule.py")
    used = set(re.findall(r'["\']([a-zA-Z ,]+)["\']', code))
    beams = {f"beam of {width}" for width in WIDTHS}
    untimed = {"greedy merging", "mending", "exact search", "reserve"}  # they take what is left
    assert set(TURNS) <= used | beams | untimed
    assert len(TURNS) == sum(map(len, TABLE.values()))


@pytest.mark.parametrize("limit", [None, 20.0])
def test_turn_ends_at_its_share(limit: float | None) -> None:
    watch = Watch(work=math.inf if limit is None else limit)
    watch.start()
    with turn_with("smoothing", share=0.5, until=0.3, most=4.0):
        assert turn("smoothing").work(watch) == pytest.approx(4.0, abs=0.1)
    with turn_with("smoothing", share=0.5, until=0.1, most=4.0):
        expected = 4.0 if limit is None else 2.0
        assert turn("smoothing").ends(watch) == pytest.approx(expected, abs=0.1)
    with turn_with("smoothing", share=0.05, until=1.0):
        expected = math.inf if limit is None else 1.0
        assert turn("smoothing").work(watch) == pytest.approx(expected, abs=0.1)
