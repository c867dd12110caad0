"""Are the maps of buildings with several floors true?

    python benchmarks/floors.py [--floors 2] [--steps 60] [--seeds 10] [--first SEED]
    python benchmarks/floors.py --folder ../shared/data/worlds/rmf60s [--pictures FOLDER]

Without a folder, a robot drives random routes through a tower of the simulator, with stars and
noisy displacements. With a folder, the traces of the Open-RMF sites in it that use lifts are
solved by the causal theory. No displacement leads from one floor to another. The script prints a
table in Markdown with a row for each trace: whether the first map is true, and how many of the
true floors are floors of the map. With `--pictures`, it draws each map. With `--beam`, only the
beams of width 1 and of this width search, without a time limit.
"""

from __future__ import annotations

import argparse
import math
import random
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from changes import cheapest
from truth import NOISE, Known, is_true, with_truth, worlds

from simulator.errors import SimulatorWarning
from simulator.robot import Body
from simulator.tours import simulate
from simulator.world import TrueDState, World
from ssh_abduction import SSHMap, Theory, solve
from ssh_abduction.data import Action
from ssh_abduction.data.drives import with_floors
from ssh_abduction.data.odometry import displacement_between
from ssh_abduction.output import to_svg

TURNS = {"right": -1, "left": 1, "around": 2}  # in quarters, counterclockwise


def towers(floors: int, steps: int, seeds: Sequence[int]) -> Iterator[Known]:
    """Yield drives on random routes through a simulated tower, one for each seed."""
    for seed in seeds:
        chance = random.Random(seed)
        tower = World.named(f"tower-{floors}")
        start = chance.choice(tower.dstates)
        route = tuple(random_route(tower, start, steps, chance))
        driven = replace(tower, start=start.pose, route=route)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", SimulatorWarning)  # The route does not return.
            trace = simulate(driven, seed=seed, body=Body(odometry=NOISE["along"]))
        views = [str(step.star) for step in trace.steps]
        yield with_truth(f"{tower.name}, {seed}", trace.with_views(views))


def random_route(
    tower: World, state: TrueDState, steps: int, chance: random.Random
) -> Iterator[str]:
    """Yield actions: a lift with probability 1/4 where there is one, otherwise along corridors."""
    there = {(s.place, quarter(s)): s for s in tower.dstates}
    place_at = {point: place for place, point in tower.places.items()}
    for _ in range(steps):
        at = tower.places[state.place]
        floors = {lift.name: place_at[lift.end] for lift in tower.lifts if lift.start == at}
        lifts = {
            name: there[place, quarter(state)]
            for name, place in floors.items()
            if (place, quarter(state)) in there
        }
        turns = {
            turn: there.get((state.place, (quarter(state) + by) % 4)) for turn, by in TURNS.items()
        }
        ways = {turn: s for turn, s in turns.items() if s and ahead(tower, s)}
        if lifts and chance.random() < 0.25:
            action, state = chance.choice([*lifts.items()])
        elif (reached := ahead(tower, state)) and chance.random() < 2 / 3:
            action, state = "travel", reached
        else:
            aside = [(turn, s) for turn, s in ways.items() if turn != "around"]
            action, state = chance.choice(aside or [*ways.items()] or [("travel", reached)])
        yield action


def quarter(state: TrueDState) -> int:
    """The heading of a dstate in quarter turns, counterclockwise."""
    return round(state.pose[2] / (math.pi / 2)) % 4


def ahead(tower: World, state: TrueDState) -> TrueDState | None:
    """The next dstate straight ahead on the path of a dstate; None at its end."""
    course = [s for s in tower.dstates if (s.path, s.direction) == (state.path, state.direction)]
    far = {s: displacement_between(state.pose, s.pose)[0] for s in course}
    return min((s for s in course if far[s] > 1), key=far.__getitem__, default=None)


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
    """The true floor of a dstate: the first part of its name."""
    return str(state).partition("-")[0]


def right_floors(ssh_map: SSHMap, known: Known) -> tuple[int, int]:
    """How many true floors are floors of the map, and how many there are where the robot was."""
    true: dict[object, set[int]] = {}
    found: dict[object, set[int]] = {}
    for t, (label, state) in enumerate(zip(ssh_map.dstate_at, known.dstates, strict=True)):
        true.setdefault(floor_of(state), set()).add(t)
        found.setdefault(ssh_map.dstates[label].floor, set()).add(t)
    return sum(steps in found.values() for steps in true.values()), len(true)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--folder", type=Path, metavar="FOLDER", help="sites of Open-RMF")
    parser.add_argument("--pictures", type=Path, metavar="FOLDER", help="draw each map here")
    parser.add_argument("--floors", type=int, default=2, choices=(2, 3))
    parser.add_argument("--steps", type=int, default=60, metavar="N", help="actions of a walk")
    parser.add_argument("--seeds", type=int, default=10, metavar="N")
    parser.add_argument("--first", type=int, default=0, metavar="SEED", help="the first seed")
    parser.add_argument("--limit", type=float, default=20, metavar="S", help="seconds for each")
    parser.add_argument("--beam", type=int, metavar="WIDTH", help="search by beams alone")
    options = parser.parse_args()
    seeds = range(options.first, options.first + options.seeds)
    traces = (
        sites(options.folder) if options.folder else towers(options.floors, options.steps, seeds)
    )
    print("| trace | steps | true dstates | dstates | true | floors |\n|---|---|---|---|---|---|")
    for known in traces:
        theory = Theory()
        if options.folder:
            star = "alike" if known.trace.has_stars else "none"
            theory = Theory.causal().replace(star=star, weigh="cost")
        if options.beam is None:
            ssh_map = solve(known.trace, theory, time_limit=options.limit).maps[0]
        else:
            found = cheapest(known.trace, theory, {1, options.beam}, joins=False)
            ssh_map = with_floors(found, known.trace)
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
