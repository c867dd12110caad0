"""Keep the folder of a run of `map` consistent: no page shows an older map and does not say so."""

from __future__ import annotations

import html
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Literal

from perception.store import written
from ssh_abduction.data.corrections import beside, load_corrections
from ssh_abduction.data.drives import fingerprints_of
from ssh_abduction.data.files import write_file
from ssh_abduction.data.trace import Trace
from ssh_abduction.page.html import view_page
from ssh_abduction.robot_logs.log_maps import recogniser_of
from ssh_abduction.solver import Solution, with_names

NOTICE = re.compile(r'<p id="made-before" role="alert">.*?</p>\n', re.DOTALL)
# What changed the folder, and what the report, which needs the log, then says.
CHANGES = {
    "names": "Made before the last names were given. page.html has them.",
    "corrections": "Made before the last correction. Solve again to obey it.",
    "maps": "Made before the map was last solved. page.html shows the new map.",
}
AGAIN = " To make this report again, map the log again into this folder."


def bring_up_to_date(maps: Path, change: Literal["names", "corrections", "maps"]) -> None:
    """Rewrite the files of a folder of `map` after `maps` or the corrections beside it changed.

    The page and the recogniser are made again. The report gets a notice, and the page, too, while
    corrections wait for a search. Does nothing in a folder that `map` did not write.
    """
    folder = maps.parent
    page, report, run = (folder / name for name in ("page.html", "report.html", "run.json"))
    if maps.name != "maps.json" or not run.is_file() or not (folder / "trace.jsonl").is_file():
        return
    solution, trace = Solution.load(maps), Trace.load(folder / "trace.jsonl")
    if not solution.maps:
        return
    waits = page.is_file() and NOTICE.search(page.read_text(encoding="utf-8"))
    notice = CHANGES["corrections"] if change == "corrections" or waits else ""
    if change == "maps":
        notice = ""
        own = solution.trace
        if own is not None and fingerprints_of(own) != fingerprints_of(trace):
            trace = own  # other drives, or more of them, were solved into this folder
            trace.save(folder / "trace.jsonl")
        if all(step.image is not None for step in trace.steps):
            recogniser = written(recogniser_of(trace, solution.maps[0]))
            write_file(folder / "recogniser.skops", recogniser)
        else:
            (folder / "recogniser.skops").unlink(missing_ok=True)
        fields = json.loads(run.read_text(encoding="utf-8"))
        made = solution.to_dict()
        fields |= {name: made.get(name) for name in ("status", "complete", "count", "theory")}
        fields["cost"] = solution.cost.to_dict() if solution.cost else None
        write_file(run, (json.dumps(fields, indent=2, ensure_ascii=False) + "\n").encode())
    if (file := beside(maps)) is not None:
        solution = with_names(load_corrections(file), replace(solution, trace=trace), trace)
    text = with_notice(view_page(solution, trace).html, notice)
    write_file(page, text.encode())
    if report.is_file():
        old = report.read_text(encoding="utf-8")
        write_file(report, with_notice(old, CHANGES[change] + AGAIN).encode())


def with_notice(text: str, notice: str) -> str:
    """Put a notice at the top of a page, in place of an earlier one; "" for none."""
    bare = NOTICE.sub("", text)
    added = f'<p id="made-before" role="alert">{html.escape(notice)}</p>\n' if notice else ""
    return re.sub(r"<h1", f"{added}<h1", bare, count=1)
