"""ssh-abduction demo: simulate a drive, map it, and open the map."""

from __future__ import annotations

import argparse
import webbrowser
from pathlib import Path

from ssh_abduction.cli.outcome import EXIT_UNPROVEN
from ssh_abduction.cli.parsing import verb
from ssh_abduction.data.errors import named

WORLD = "doors"  # a corridor with rooms
# Units of work for the search. They suffice for a good map, and a demo is short.
WORK = 5


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
