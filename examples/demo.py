"""Solve the route of a real robot in the ACES building, then map a house from a robot's log.

    python examples/demo.py [FOLDER]

The script prints the minimal maps of the route and in what they differ, and draws one of them.
Files are written to FOLDER (default: out).
"""

from __future__ import annotations

import argparse
from pathlib import Path

from ssh_abduction import Theory, Trace, check, compare, solve
from ssh_abduction.cli import main as main_of_the_shell
from ssh_abduction.cli.text import compared, describe
from ssh_abduction.output import to_svg


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument(
        "folder", type=Path, nargs="?", default=Path("out"), help="where files go (default: out)"
    )
    folder = parser.parse_args().folder
    trace = Trace.load(Path(__file__).parent / "aces3-route.jsonl")
    theory = Theory.topological()
    solution = solve(trace, theory)
    cost = solution.cost
    print(f"{trace.name}: {len(trace)} images, {len(set(trace.views))} views")
    print(
        f"fewest: {cost.dstates} dstates, {cost.places} places, {cost.paths} paths; "
        f"{solution.count} minimal maps, {solution.seconds.total:.2f} s"
    )
    for i, ssh_map in enumerate(solution.maps):
        violations = check(trace, ssh_map, theory)
        print(f"\nmap {i + 1}: {violations or 'satisfies every axiom'}\n{describe(ssh_map)}")
    print("\nwhat tells them apart", *compared(compare(solution)), sep="\n")
    folder.mkdir(parents=True, exist_ok=True)
    picture = folder / "aces3-map.svg"
    picture.write_text(to_svg(solution.maps[0]) + "\n", encoding="utf-8")
    print(f"\nmap 1 is drawn in {picture}")
    print("\na simulated robot drives through a house with doors, and its log is mapped")
    main_of_the_shell(["demo", "-o", str(folder), "--set", "open=false"])


if __name__ == "__main__":
    main()
