"""Are the maps of buildings with several floors true?

    python benchmarks/floors.py [--floors 2] [--cells 3] [--steps 60] [--seeds 10] [--first SEED]
    python benchmarks/floors.py --folder ../shared/data/worlds/rmf60s [--pictures FOLDER]

Without a folder, a robot drives through mazes that lifts connect, with stars and noisy
displacements. With a folder, the traces of the Open-RMF sites in it that use lifts are solved by
the causal theory. No displacement leads from one floor to another. The script prints a table in
Markdown with a row for each trace: whether the first map is true, and how many of the true floors
are floors of the map. With `--pictures`, it draws each map.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from instances import tower
from truth import NOISE, Known, is_true, worlds

from ssh_abduction import SSHMap, Theory, solve
from ssh_abduction.data import Action, Odometry
from ssh_abduction.output import to_svg


def towers(floors: int, cells: int, steps: int, seeds: Sequence[int]) -> Iterator[Known]:
    """Yield random walks in mazes that lifts connect, one for each seed."""
    for seed in seeds:
        walk = tower(floors, cells, steps=steps, seed=seed, odometry=Odometry(**NOISE))
        states = [state for state in walk.truth if isinstance(state, tuple)]
        places = tuple(state[:3] for state in states)
        yield Known(f"{floors} floors, {seed}", walk.trace, walk.truth, places)


def sites(folder: Path) -> Iterator[Known]:
    """Yield the traces of a folder that use lifts, with their lifts as actions of this kind."""
    for known in worlds(folder):
        steps = list(known.trace.steps)
        lifted = [t for t, a in enumerate(known.trace.actions, 1) if a.name.startswith("lift")]
        for t in lifted:
            steps[t - 1] = replace(
                steps[t - 1], action=Action(known.trace.actions[t - 1].name, "lift")
            )
            steps[t] = replace(steps[t], displacement=None, covariance=None)
        if lifted:
            yield replace(known, trace=replace(known.trace, steps=tuple(steps)))


def floor_of(state: object) -> object:
    """The true floor of a dstate: the first part of its name, or of its tuple."""
    return state.partition("-")[0] if isinstance(state, str) else next(iter(state))


def right_floors(ssh_map: SSHMap, known: Known) -> tuple[int, int]:
    """How many true floors are floors of the map, and how many there are where the robot was."""
    true: dict[object, set[int]] = {}
    found: dict[object, set[int]] = {}
    for t, (label, state) in enumerate(zip(ssh_map.labels, known.dstates, strict=True)):
        true.setdefault(floor_of(state), set()).add(t)
        found.setdefault(ssh_map.dstates[label].floor, set()).add(t)
    return sum(steps in found.values() for steps in true.values()), len(true)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--folder", type=Path, metavar="FOLDER", help="sites of Open-RMF")
    parser.add_argument("--pictures", type=Path, metavar="FOLDER", help="draw each map here")
    parser.add_argument("--floors", type=int, default=2, metavar="N")
    parser.add_argument("--cells", type=int, default=3, metavar="N", help="mazes of N x N cells")
    parser.add_argument("--steps", type=int, default=60, metavar="N", help="actions of a walk")
    parser.add_argument("--seeds", type=int, default=10, metavar="N")
    parser.add_argument("--first", type=int, default=0, metavar="SEED", help="the first seed")
    parser.add_argument("--limit", type=float, default=20, metavar="S", help="seconds for each")
    options = parser.parse_args()
    seeds = range(options.first, options.first + options.seeds)
    traces = (
        sites(options.folder)
        if options.folder
        else towers(options.floors, options.cells, options.steps, seeds)
    )
    print("| trace | steps | true dstates | dstates | true | floors |\n|---|---|---|---|---|---|")
    for known in traces:
        theory = Theory()
        if options.folder:
            star = "alike" if known.trace.has_stars else "none"
            theory = Theory.causal().replace(star=star, weigh="cost")
        ssh_map = solve(known.trace, theory, time_limit=options.limit).maps[0]
        right, there = right_floors(ssh_map, known)
        print(
            f"| {known.name} | {len(known.trace)} | {len(set(known.dstates))} | "
            f"{len(ssh_map.dstates)} | {'yes' if is_true(ssh_map, known) else 'no'} | "
            f"{right} of {there} |",
            flush=True,
        )
        if options.pictures:
            options.pictures.mkdir(exist_ok=True, parents=True)
            (options.pictures / f"{known.name}.svg").write_text(to_svg(ssh_map, known.trace))


if __name__ == "__main__":
    main()
