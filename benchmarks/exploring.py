"""Steps until a robot has the true map: an exploring robot beside simpler ways to drive.

    python benchmarks/exploring.py --family mazes --cells 3 --seeds 20 --out results.jsonl
    python benchmarks/exploring.py --family plans --only Borchen4,Sabadell1 --out results.jsonl
    python benchmarks/exploring.py --table results.jsonl [--plot docs/figures/exploring.png]

All strategies begin in the same world at the same dstate (distinctive state: a place and a heading
there). A robot *has the map* after a number of steps if it has done every travel, and if all
minimal maps of these steps have the true dstates. If the theory has places, these must be true too.
Maps that differ only in paths count as one. The number is searched after the drive: growing
prefixes are solved, beginning with the step at which everything was visited, and then the interval
is halved. The explorer also says itself when it is done.

    explorer  Explorer of ssh_abduction/online/explorer.py.
    random    Any action that the robot can do, drawn uniformly.
    rule      Mazes: look around at each place, then follow the wall to the right.
              Plans: the drive of benchmarks/plan_tours.py, which knows where the robot is and
              goes through the door that it passed least often.
    hW        AALpy's learner without resets. Its oracle knows the truth, and only the steps of a
              shortest counterexample are counted. An impossible action costs nothing. So hW does
              better here than it could in reality. It sees views and stars, and it learns all
              links. It is done when its machine predicts the same as the world.

The table also has the length of the shortest walk that sees and does everything, which a driver
could choose who knows the world.

Theories: topological with stars for mazes; causal with stars compared by tolerance for plans.
"""

from __future__ import annotations

import argparse
import json
import random
import statistics
import time
from collections import deque
from collections.abc import Callable, Collection, Hashable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from arguments import add_number
from instances import HEADINGS, TURNS, doors_of
from plan_tours import Floor, RoomPlan
from truth import Known, is_true, share_all

from ssh_abduction import Theory, Trace, solve
from ssh_abduction.data.trace import Action, Step
from ssh_abduction.online.explorer import Explorer
from ssh_abduction.rivals.tour import StanceMove, shortest_flow

ROOT = Path(__file__).parent.parent
MOVES = {name: Action.of(name) for name in ("travel", "right", "around", "left")}
STRATEGIES = ("explorer", "random", "rule", "hW")
Record = dict[str, Any]


class World(Protocol):
    """A world for a robot to drive in. Its states are the true dstates.

    Attributes:
        name: Name of the world.
        theory: Theory of the maps.
        margin: The `margin` of `Explorer` in this world.
        start: State in which a robot begins.
    """

    name: str
    theory: Theory
    margin: int
    start: Any

    def sight(self, state: Any) -> Step: ...

    def ends(self, state: Any) -> dict[Action, Any]: ...

    def place(self, state: Any) -> Hashable: ...

    def rule(self) -> Iterator[Action]:
        """Yield the actions of a drive by a fixed rule, without end."""


class Maze:
    """A square maze of corridors.

    A dstate is a cell and a heading. A view is the openings ahead, right, back and left. The robot
    can turn to any side.
    """

    theory, margin = Theory.topological(), 4

    def __init__(self, cells: int, seed: int) -> None:
        chance = random.Random(seed)
        self.name = f"maze {cells} x {cells}, {seed}"
        self._doors = doors_of(cells, cells, chance)
        self.start = (chance.randrange(cells), chance.randrange(cells), chance.randrange(4))

    def sight(self, state: tuple[int, int, int]) -> Step:
        star = tuple(int((state[:2], ahead(state, turn)) in self._doors) for turn in range(4))
        return Step("".join(map(str, star)), star=star)

    def ends(self, state: tuple[int, int, int]) -> dict[Action, tuple[int, int, int]]:
        x, y, heading = state
        found = {MOVES[name]: (x, y, (heading + turn) % 4) for name, turn in TURNS.items()}
        return found | (
            {MOVES["travel"]: (*ahead(state, 0), heading)}
            if (state[:2], ahead(state, 0)) in self._doors
            else {}
        )

    def place(self, state: tuple[int, int, int]) -> Hashable:
        return state[:2]

    def rule(self) -> Iterator[Action]:
        """Yield the actions of a drive: look around at each place, then follow the right wall."""
        state = self.start
        while True:
            yield from [MOVES["right"]] * 4
            turn = next(
                turn for turn in (1, 0, 3, 2) if (state[:2], ahead(state, turn)) in self._doors
            )
            yield from [move for name, move in MOVES.items() if TURNS.get(name) == turn]
            yield MOVES["travel"]
            state = (*ahead(state, turn), (state[2] + turn) % 4)


def ahead(state: tuple[int, int, int], turn: int) -> tuple[int, int]:
    """Return the cell that the robot would face after some quarter turns clockwise."""
    dx, dy = HEADINGS[(state[2] + turn) % 4]
    return state[0] + dx, state[1] + dy


class Building:
    """A floor plan. Its rooms are places."""

    theory, margin = Theory.causal().replace(star="alike"), 0

    def __init__(self, file: Path) -> None:
        self._floor = Floor(RoomPlan.load(file).told_apart())
        self.name, self.start = self._floor.plan.name, self._floor.start
        self.sight, self.ends = self._floor.sight, self._floor.ends

    def place(self, state: Any) -> Hashable:
        return state.room

    def rule(self) -> Iterator[Action]:
        """Yield the actions of a drive: leave each room by the door that was passed least often.

        The robot goes back through the same door only if the room has no other.
        """
        state, passed, came_by = self.start, dict[int, int](), -1
        while True:
            gateways = self._floor.plan.gateways[state.room]
            choices = [k for k, g in enumerate(gateways) if g.door != came_by] or [
                *range(len(gateways))
            ]
            goal = min(choices, key=lambda k: (passed.get(gateways[k].door, 0), k))
            came_by = gateways[goal].door
            for action, after in self._floor.way_through(state, goal):
                yield action
                state = after
            passed[came_by] = passed.get(came_by, 0) + 1


@dataclass
class Driven:
    """A robot in a world, with everything that it did and saw. The explorer can drive it."""

    world: World

    def __post_init__(self) -> None:
        self.truth = [self.world.start]
        self.steps: list[Step] = []
        self.done: list[Action] = []

    def look(self) -> Step:
        return self.world.sight(self.truth[-1])

    def can(self) -> Collection[Action]:
        return list(self.world.ends(self.truth[-1]))

    def do(self, action: Action) -> None:
        self.done.append(action)
        self.truth.append(self.world.ends(self.truth[-1])[action])

    def trace(self, actions: int) -> Trace:
        """Make the trace of the first `actions` actions."""
        seen = [self.world.sight(state) for state in self.truth[: actions + 1]]
        return Trace.from_steps(
            [step.view for step in seen], self.done[:actions], stars=[step.star for step in seen]
        )  # type: ignore[arg-type, misc]


def states_of(world: World) -> dict[Any, dict[Action, Any]]:
    """Return a dict from each dstate of a world to its actions and where they lead."""
    found: dict[Any, dict[Action, Any]] = {}
    left = [world.start]
    while left:
        state = left.pop()
        if state not in found:
            found[state] = world.ends(state)
            left += found[state].values()
    return found


def everything(ends: dict[Any, dict[Action, Any]]) -> set[Any]:
    """Return the set of what a robot has to see and do: all dstates and all travels.

    A travel is a pair of a dstate and the name of the action.
    """
    return {*ends} | {
        (state, action.name) for state in ends for action in ends[state] if action.kind == "travel"
    }


def shortest(world: World) -> int:
    """Compute the number of actions of the shortest walk through all dstates and travels."""
    ends = states_of(world)
    number = {state: n for n, state in enumerate(ends)}
    moves = [
        StanceMove(number[state], action, number[there], "known")
        for state in ends
        for action, there in ends[state].items()
    ]
    travels = {k for k, move in enumerate(moves) if move.action.kind == "travel"}
    times = shortest_flow(
        moves, number[world.start], travels, set(number.values()), rounds=1000, patience=600
    )
    assert times is not None
    return sum(times)


def covered_after(robot: Driven) -> int | None:
    """Count the actions until all dstates were visited and all travels done; None if never."""
    ends = states_of(robot.world)
    missing = everything(ends) - {robot.truth[0]}
    for t, action in enumerate(robot.done, 1):
        missing -= {robot.truth[t], (robot.truth[t - 1], action.name)}
        if not missing:
            return t
    return None


def has_map(robot: Driven, actions: int, limit: float) -> bool:
    """Check whether the minimal maps of the first actions are true, and differ only in paths.

    Args:
        robot: The robot, with what it did and saw.
        actions: Number of actions.
        limit: Seconds for the solve.
    """
    trace = robot.trace(actions)
    truth = tuple(robot.truth[: actions + 1])
    known = Known("", trace, truth, tuple(map(robot.world.place, truth)))
    solution = solve(trace, robot.world.theory, time_limit=limit, max_maps=20)
    return (
        bool(solution.maps)
        and all(is_true(m, known) for m in solution.maps)
        and (solution.complete or share_all(solution))
    )


def steps_to_map(robot: Driven, limit: float) -> int | None:
    """Find the number of actions after which the robot had the map; None if it never had it.

    Args:
        robot: The robot, with what it did and saw.
        limit: Seconds for each solve.
    """
    low = covered_after(robot)
    if low is None:
        return None
    high, last = low, len(robot.done)
    while not has_map(robot, high, limit):
        if high == last:
            return None
        low, high = high + 1, min(last, high + max(high // 8, 4))
    while low < high:
        middle = (low + high) // 2
        low, high = (low, middle) if has_map(robot, middle, limit) else (middle + 1, high)
    return high


def explorer(
    world: World,
    seed: int,
    most: int,
    limit: float,
    seconds: float = float("inf"),
    judged: bool = False,
) -> Record:
    """Run the explorer until it ends.

    Args:
        world: The world to explore.
        seed: Not used; all strategies have the same arguments.
        most: Largest number of actions.
        limit: Seconds for a solve.
        seconds: Largest number of CPU seconds.
        judged: Whether to stop as soon as the robot has the true map.

    Returns:
        Results by name: steps until the robot had the map, actions, CPU seconds; and how the
        explorer ended, if it did.
    """
    robot, missing = Driven(world), everything(states_of(world))
    found = Explorer(robot, world.theory, margin=world.margin, time_limit=limit)
    began = time.process_time()
    goes_on = True
    while goes_on and len(robot.done) < most and time.process_time() - began < seconds:
        goes_on = found.step()
        missing -= {*robot.truth[-2:]} | {
            (state, action.name)
            for state, action in zip(robot.truth[-2:], robot.done[-1:], strict=False)
        }
        if judged and not missing and has_map(robot, len(robot.done), 10 * limit):
            break
    spent = {"driven": len(robot.done), "seconds": round(time.process_time() - began, 1)}
    steps = steps_to_map(robot, 10 * limit)
    if goes_on:
        return {"steps": steps, **spent}
    ending = found.result.ending
    told = {
        "stopped": len(robot.done),
        "ending": ending,
        "done": ending == "done",
        "true": has_map(robot, len(robot.done), 10 * limit),
    }
    return {"steps": steps, **told, **spent}


def random_walk(world: World, seed: int, most: int, limit: float) -> Record:
    robot, chance = Driven(world), random.Random(f"walk {seed}")
    return walked(robot, (chance.choice([*robot.can()]) for _ in range(most)), limit)


def rule(world: World, seed: int, most: int, limit: float) -> Record:
    return walked(
        Driven(world), (action for action, _ in zip(world.rule(), range(most), strict=False)), limit
    )


def walked(robot: Driven, actions: Iterator[Action], limit: float) -> Record:
    """Do the actions, and stop some time after everything was visited.

    Returns:
        Results by name: steps until the robot had the map, actions, and seconds.
    """
    began = time.perf_counter()
    missing = everything(states_of(robot.world))
    after = 0
    for action in actions:
        missing -= {robot.truth[-1], (robot.truth[-1], action.name)}
        robot.do(action)
        after = 0 if missing - {robot.truth[-1]} else after + 1
        if after > len(robot.done) / 2:
            break
    return {
        "steps": steps_to_map(robot, limit),
        "driven": len(robot.done),
        "seconds": round(time.perf_counter() - began, 1),
    }


def learnt(world: World, seed: int, most: int, limit: float) -> Record:
    """Run hW, the learner of AALpy. Arguments are those of `explorer`."""
    from aalpy import SUL, hWOracle, run_hW

    ends, chance = states_of(world), random.getstate()
    letters = sorted({action.name for leads in ends.values() for action in leads})
    by_name = {
        state: {action.name: there for action, there in leads.items()}
        for state, leads in ends.items()
    }
    shows = {state: f"{(seen := world.sight(state)).view} {seen.star}" for state in ends}

    class Driving(SUL):  # type: ignore[misc]
        def __init__(self) -> None:
            super().__init__()
            self.state, self.driven = world.start, 0

        def pre(self) -> None: ...

        def post(self) -> None: ...

        def step(self, letter: str | None) -> str:
            there = by_name[self.state].get(letter or "")
            if there is not None:
                self.state, self.driven = there, self.driven + 1
                if self.driven > most:
                    raise TooLongError
            return shows[self.state]

    driving = Driving()

    class Knows(hWOracle):  # type: ignore[misc]
        def find_cex(self, hypothesis: Any) -> tuple[str, ...] | None:
            first = (hypothesis.current_state, driving.state)
            came: dict[Any, tuple[Any, str] | None] = {first: None}
            queue = deque([first])
            while queue:
                pair = queue.popleft()
                if came[pair] is not None and pair[0].output != shows[pair[1]]:
                    words: list[str] = []
                    at: Any = pair
                    while came[at] is not None:
                        at, letter = came[at]  # type: ignore[misc]
                        words.append(letter)
                    cex: list[str] = []
                    self._execute_and_compare(hypothesis, tuple(words[::-1]), cex)
                    return tuple(cex)
                for letter in letters:
                    there = (pair[0].transitions[letter], by_name[pair[1]].get(letter, pair[1]))
                    if there not in came:
                        came[there] = (pair, letter)
                        queue.append(there)
            return None

    random.seed(seed)
    began = time.perf_counter()
    try:
        run_hW(letters, driving, Knows(), "moore", query_for_initial_state=False, print_level=0)
        steps: int | None = driving.driven
    except TooLongError:
        steps = None
    finally:
        random.setstate(chance)
    return {
        "steps": steps,
        "driven": driving.driven,
        "seconds": round(time.perf_counter() - began, 1),
    }


class TooLongError(Exception):
    """A run was stopped because it took too many steps."""


RUN: dict[str, Callable[..., Record]] = {
    "explorer": explorer,
    "random": random_walk,
    "rule": rule,
    "hW": learnt,
}


def worlds(options: argparse.Namespace) -> Iterator[tuple[World, int]]:
    if options.family == "mazes":
        yield from (
            (Maze(options.cells, seed), seed)
            for seed in range(options.first, options.first + options.seeds)
        )
        return
    for file in sorted(options.folder.glob("*.xml"), key=lambda file: file.stem.lower()):
        if not options.only or any(name in file.stem for name in options.only.split(",")):
            yield from (
                (Building(file), seed)
                for seed in range(options.first, options.first + options.seeds)
            )


def table(records: Sequence[Record]) -> str:
    """Make a table in Markdown, with a row for each world and one for the medians.

    A row has the number of steps until each robot has the map, and the number after which the
    explorer stops. That column is empty if the explorer was stopped before its end.
    """
    names = [*dict.fromkeys(record["world"] for record in records)]
    by = {(record["world"], record["strategy"]): record for record in records}
    lines = [
        "| world | dstates | shortest | explorer | random | rule | hW | explorer / "
        "best other | it stops | then |",
        "|---" * 10 + "|",
    ]
    columns: dict[str, list[float]] = {
        name: [] for name in (*STRATEGIES, "shortest", "stopped", "ratio")
    }
    ends: list[str] = []
    for name in names:
        row = {strategy: by.get((name, strategy), {}) for strategy in STRATEGIES}
        steps = {
            strategy: float("inf") if said.get("steps") is None else said["steps"]
            for strategy, said in row.items()
        }
        best = min(steps[strategy] for strategy in STRATEGIES[1:])
        for strategy in STRATEGIES:
            columns[strategy].append(steps[strategy])
        columns["ratio"].append(
            min(steps["explorer"] / best, 99)
            if best < float("inf")
            else 0.0
            if steps["explorer"] < float("inf")
            else 1.0
        )
        some = next(record for record in records if record["world"] == name)
        columns["shortest"].append(some["shortest"])
        said = row["explorer"]
        if "stopped" in said:
            columns["stopped"].append(said["stopped"])
            ends.append(f"{said['ending']}, {'true' if said['true'] else 'not true'}")
        ratio = f"{columns['ratio'][-1]:.2f}" if columns["ratio"][-1] < 99 else ""
        told = " | ".join(_told(steps[s], row[s]) for s in STRATEGIES)
        ending = f"{said['stopped']} | {ends[-1]}" if "stopped" in said else " | "
        lines.append(
            f"| {name} | {some['dstates']} | {some['shortest']} | {told} | {ratio} | {ending} |"
        )
    medians = {
        name: _number(statistics.median(values)) if values else ""
        for name, values in columns.items()
    }
    lines.append(
        f"| median of {len(names)} | | {medians['shortest']} | "
        f"{' | '.join(medians[s] for s in STRATEGIES)} | "
        f"{statistics.median(columns['ratio']):.2f} | {medians['stopped']} | "
        f"{'; '.join(f'{ends.count(end)} {end}' for end in dict.fromkeys(ends))} |"
    )
    return "\n".join(lines)


def _told(steps: float, said: Record) -> str:
    return (
        _number(steps)
        if steps < float("inf")
        else f"not in {said['driven']:,}"
        if "driven" in said
        else ""
    )


def _number(steps: float) -> str:
    return "–" if steps == float("inf") else f"{steps:,g}"


def plot(records: Sequence[Record], file: Path) -> None:
    """Draw the steps until a robot has the map: a dot for each run, and a line for each world."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    families = [*dict.fromkeys(record["family"] for record in records)]
    figure, axes = plt.subplots(
        1, len(families), figsize=(4.2 * len(families), 3.6), sharey=True, squeeze=False
    )
    for axis, family in zip(axes[0], families, strict=True):
        some = [record for record in records if record["family"] == family]
        runs = [*dict.fromkeys(record["world"] for record in some)]
        for world in runs:
            steps = {
                record["strategy"]: record["steps"] for record in some if record["world"] == world
            }
            at = [(i, steps[s]) for i, s in enumerate(STRATEGIES) if steps.get(s)]
            if not at:
                continue
            axis.plot(*zip(*at, strict=True), color="0.8", linewidth=0.7, zorder=1)
            axis.scatter(*zip(*at, strict=True), s=14, color="#0072B2", zorder=2)
        for i, strategy in enumerate(STRATEGIES):
            values = [
                record["steps"] or float("inf") for record in some if record["strategy"] == strategy
            ]
            middle = statistics.median(values) if values else float("inf")
            if middle < float("inf"):
                axis.plot(
                    [i - 0.3, i + 0.3], [middle, middle], color="#D55E00", linewidth=2, zorder=3
                )
            missing = sum(value == float("inf") for value in values)
            if missing:
                axis.annotate(
                    f"{missing} of {len(values)}\nnever",
                    (i, 1.0),
                    xycoords=("data", "axes fraction"),
                    ha="center",
                    va="top",
                    fontsize=7,
                )
        axis.set_xticks(range(len(STRATEGIES)), STRATEGIES)
        axis.set_title(f"{family} ({len(runs)})", fontsize=10)
        axis.set_xlim(-0.5, len(STRATEGIES) - 0.5)
        axis.set_yscale("log")
        axis.set_ylim(
            top=max(record["steps"] or 1 for record in records) * 3
        )  # runs that never had the map are counted above the dots
        axis.grid(axis="y", color="0.9")
    axes[0][0].set_ylabel("steps until the map is unique and true")
    figure.tight_layout()
    figure.savefig(file, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--family", choices=("mazes", "plans"), default="mazes")
    add_number(parser, "--cells", "N", 3, "mazes of N x N cells")
    add_number(parser, "--seeds", "N", 1, "worlds, or runs of each plan")
    add_number(parser, "--first", "SEED", 0, "the first seed")
    parser.add_argument(
        "--folder",
        type=Path,
        default=ROOT.parent / "shared" / "data" / "plans",
        metavar="FOLDER",
        help="folder of the plans",
    )
    parser.add_argument(
        "--only",
        default="",
        metavar="NAMES",
        help="run only plans whose names contain one of these parts, separated by commas",
    )
    parser.add_argument(
        "--strategies",
        default=",".join(STRATEGIES),
        metavar="NAMES",
        help="strategies to run, separated by commas",
    )
    parser.add_argument(
        "--most",
        type=int,
        default=20_000,
        metavar="N",
        help="give up after this many steps (default 20000; explorer 2000)",
    )
    add_number(parser, "--limit", "S", 3.0, "approximate seconds for a solve")
    parser.add_argument(
        "--seconds",
        type=float,
        default=float("inf"),
        metavar="S",
        help="CPU time for a run of the explorer (default: no limit)",
    )
    parser.add_argument(
        "--judged",
        action="store_true",
        help="end a run of the explorer as soon as it has the true map",
    )
    parser.add_argument(
        "--out",
        type=Path,
        metavar="RESULTS.jsonl",
        help="file for the results; runs that it contains are not repeated",
    )
    parser.add_argument(
        "--table",
        type=Path,
        metavar="RESULTS.jsonl",
        help="print a table of stored results instead",
    )
    parser.add_argument("--plot", type=Path, metavar="PNG", help="with --table, also draw them")
    options = parser.parse_args()
    if options.table:
        records = [json.loads(line) for line in options.table.read_text().splitlines()]
        for family in dict.fromkeys(record["family"] for record in records):
            of_family = [record for record in records if record["family"] == family]
            print(f"\n{family}\n\n{table(of_family)}")
        if options.plot:
            plot(records, options.plot)
        return
    family = f"mazes {options.cells} x {options.cells}" if options.family == "mazes" else "plans"
    stored = options.out.read_text().splitlines() if options.out and options.out.exists() else []
    known = {(record["world"], record["strategy"]) for record in map(json.loads, stored)}
    for world, seed in worlds(options):
        least = shortest(world)
        for strategy in options.strategies.split(","):
            if (world.name, strategy) in known:
                continue
            most = min(options.most, 2000) if strategy == "explorer" else options.most
            told = (
                {"seconds": options.seconds, "judged": options.judged}
                if strategy == "explorer"
                else {}
            )
            said = RUN[strategy](world, seed, most, options.limit, **told)
            record = {
                "family": family,
                "world": world.name,
                "dstates": len(states_of(world)),
                "shortest": least,
                "strategy": strategy,
                **said,
            }
            print(json.dumps(record), flush=True)
            if options.out:
                with options.out.open("a") as file:
                    file.write(json.dumps(record) + "\n")


if __name__ == "__main__":
    main()
