"""Keep the folder of a run of `map` consistent: no page shows an older map and does not say so."""

from __future__ import annotations

import html
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Literal

from ssh_abduction.data.corrections import CORRECTED, beside, load_corrections
from ssh_abduction.data.drives import fingerprints_of
from ssh_abduction.data.files import write_file
from ssh_abduction.data.trace import Trace
from ssh_abduction.page.content import Section
from ssh_abduction.page.html import ground_in, view_page
from ssh_abduction.robot_logs.log_maps import recogniser_file
from ssh_abduction.robot_logs.log_report import OF_LOG
from ssh_abduction.solution import Solution, with_names

NOTICE = re.compile(r'<p id="made-before" role="alert">.*?</p>\n', re.DOTALL)
SOLVED = (
    "The map was solved again. The walls are where the map before it put them. To draw them anew, "
    "map the log again into this folder."
)


def bring_up_to_date(maps: Path, change: Literal["names", "corrections", "maps"]) -> None:
    """Rewrite the files of a folder of `map` after `maps` or the corrections beside it changed.

    The page and the recogniser are made again. The page gets a notice while corrections wait for a
    search. Does nothing in a folder that `map` did not write.
    """
    folder = maps.parent
    page, run = folder / "page.html", folder / "run.json"
    if maps.name != "maps.json" or not run.is_file() or not (folder / "trace.jsonl").is_file():
        return
    solution, trace = Solution.load(maps), Trace.load(folder / "trace.jsonl")
    if not solution.maps:
        return
    ground = ground_in(page, len(trace))
    waits = page.is_file() and NOTICE.search(page.read_text(encoding="utf-8"))
    is_old = change == "corrections" or (waits and change == "names")
    if change == "maps":
        own = solution.trace
        if own is not None and fingerprints_of(own) != fingerprints_of(trace):
            trace, ground = own, None  # other drives, or more of them, were solved into this folder
            trace.save(folder / "trace.jsonl")
        if ground is not None:
            kept = [section for section in ground.sections if section.title == OF_LOG]
            ground = replace(ground, sections=(Section("Summary", (SOLVED,)), *kept))
        if all(step.image is not None for step in trace.steps):
            write_file(folder / "recogniser.skops", recogniser_file(trace, solution.maps[0]))
        else:
            (folder / "recogniser.skops").unlink(missing_ok=True)
        fields = json.loads(run.read_text(encoding="utf-8"))
        made = solution.to_dict()
        fields |= {name: made.get(name) for name in ("status", "complete", "count", "theory")}
        fields["cost"] = solution.cost.to_dict() if solution.cost else None
        write_file(run, (json.dumps(fields, indent=2, ensure_ascii=False) + "\n").encode())
    if (file := beside(maps)) is not None:
        solution = with_names(load_corrections(file), replace(solution, trace=trace), trace)
    text = view_page(solution, trace, ground=ground).html
    write_file(page, with_notice(text, CORRECTED if is_old else "").encode())


def with_notice(text: str, notice: str) -> str:
    """Put a notice at the top of a page, in place of an earlier one; "" for none."""
    bare = NOTICE.sub("", text)
    added = f'<p id="made-before" role="alert">{html.escape(notice)}</p>\n' if notice else ""
    return re.sub(r"<h1", f"{added}<h1", bare, count=1)
