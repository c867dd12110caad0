"""Every public function and method is called with wrong arguments. It raises one of the package's
errors, or a table says why the value is right.

The callables are those of the reference, so new ones are included. The test fails if a parameter
has no good value below.
"""

from __future__ import annotations

import contextlib
import inspect
import io
import itertools
import os
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import hooks
import numpy as np
import pytest

from perception.views import ViewClusterer
from simulator.plans import Door, Plan, Room
from simulator.robot import Laser
from simulator.tours import simulate
from simulator.world import World
from ssh_abduction import (
    AbductionError,
    Explorer,
    Localiser,
    OnlineMapper,
    Theory,
    Trace,
    compare,
    evaluate,
    next_experiment,
    route,
    solve,
    view_page,
)
from ssh_abduction.data import (
    Action,
    Closure,
    Corrections,
    Odometry,
    Said,
    Step,
    drives_of,
    save_corrections,
)
from ssh_abduction.evaluation import evaluate_visits
from ssh_abduction.learning.learner import BootstrapLearner
from ssh_abduction.online import Chances
from ssh_abduction.rivals import Listing, difference
from ssh_abduction.solution import Level
from ssh_abduction.solver import Search
from ssh_abduction.theory import Speedups

SHIPPED = Path(inspect.getfile(World)).parent / "worlds" / "notched-rectangle.json"

# The wrong values for each argument. Functions make those that each call needs anew.
WRONG: dict[str, Callable[[], Any]] = {
    "None": lambda: None,
    "object": object,
    "3.5": lambda: 3.5,
    "-1": lambda: -1,
    "True": lambda: True,
    "NaN": lambda: float("nan"),
    "inf": lambda: float("inf"),
    "empty text": str,
    "nonsense": lambda: "nonsense",
    "bytes": lambda: b"x",
    "list": list,
    "dict": dict,
    "array": lambda: np.arange(3),
    "huge": lambda: 10**30,
    "generator": lambda: (x for x in ()),
    "half a character": lambda: "a\ud800",
    "null character": lambda: "a\0b",
    "folder": lambda: os.curdir,
    "[object]": lambda: [object()],
    "[1, 2]": lambda: [1, 2],
}
TEXTS = {"empty text", "nonsense", "half a character", "null character", "folder"}
EMPTY = {"list", "generator"}
# Any value is right: only evaluation reads `truth`, which may be any JSON, and estimators ignore
# the labels `y` that scikit-learn passes.
ANYTHING = {"truth", "y"}

# Which of these are right, by the kind of parameter. A parameter with default None also takes None.
RIGHT_BY_NAME: dict[str, set[str]] = {
    "place": {"huge"},
    "time_limit": {"None", "3.5", "inf", "huge"},
    "work_limit": {"None", "3.5", "inf", "huge"},
    "memory_limit": {"None", "3.5", "inf", "huge"},
    "max_maps": {"None", "huge"},
    "maps": {"huge", *EMPTY},
    "margin": {"huge"},
    "seed": {"huge"},
    "within": {"huge"},
    "where": TEXTS,
    "name": TEXTS,
    "images": TEXTS,
    "drive": TEXTS,
    "source": TEXTS,
    "view": {"-1", "empty text", "nonsense", "folder"},
    "action": {"nonsense", "folder"},
    "actions": EMPTY,
    "avoid": EMPTY,
    "star": {"list", "array", "[1, 2]"},
    "displacement": {"array"},
    "odometry": {"dict"},
    "extra": {"dict"},
    "turns": {"None", "dict"},
    "every": {"3.5", "huge"},
    "near": {"3.5", "huge"},
    "turned": {"3.5", "huge"},
}
RIGHT: dict[str, set[str]] = {
    "route.start": {"None"},  # the last dstate
    "Step.of.view": {"None", "-1", "empty text", "nonsense", "folder"},
    "Action.of.value": {"nonsense", "folder"},
    "Action.that_slipped.step": {"huge"},
    "MapPath.left_of.place": {"huge"},
    "MapPath.right_of.place": {"huge"},
    "Belief.found_again.sure": {"3.5", "huge"},
    "Certificate.to_dict.trace": {"None"},
    "Closure.last": {"huge"},
    "Corrections.known_in.drives": EMPTY,
    "Corrections.named.drives": EMPTY,
    "Corrections.of_names.drives": EMPTY,
    "Corrections.with_gateway.is_open": {"True"},
    "Corrections.with_gateway.seen": EMPTY,
    "Corrections.with_name.name": {"nonsense", "folder"},
    "Cost.preferred_by.theory": {"None"},
    "Explorer.explore.steps": {"huge"},
    "Odometry.of.value": {"dict"},
    "Plan.rooms": EMPTY,
    "Plan.doors": EMPTY,
    "SSHMap.right_of.direction": {"-1"},
    "Speedups.that_hold_for.theory": {"None"},
    "Speedups.without.names": {"empty text", "dict", *EMPTY},
    "SSHMap.called.number": {"huge"},
    "SSHMap.name_of.number": {"None", "huge"},
    "SSHMap.numbered.number": {"huge"},
    "Listing.named_beside.path": TEXTS,
    "load_corrections.path": {"empty text", "folder"},
    "save_corrections.path": {"empty text", "nonsense", "folder"},
    "Step.image": {"list", "array", "huge", "[1, 2]"},
    "Theory.from_dict.data": {"dict"},
    "difference.drives": EMPTY,
    "explain_pair.known": EMPTY,
    "explain_place.known": EMPTY,
    "Theory.prefer": {"list"},
    "Theory.without": {"list"},
    "Theory.rules": {"empty text", *EMPTY},
    "Theory.of_steps.first": {"huge"},
    "Theory.of_steps.length": {"huge"},
    **{f"Theory.{pairs}": EMPTY for pairs in ("same", "different", "elsewhere", "same_place")},
    **{f"Theory.{price}": {"3.5"} for price in ("misread", "slipped", "jumped", "changed")},
    **{f"{written}.save.path": {"nonsense"} for written in ("Page", "Solution", "SSHMap", "Trace")},
    "Trace.at.step": {"huge"},
    "Trace.closures": EMPTY,
    "Trace.from_steps.views": {"[1, 2]"},
    "Trace.prefix.steps": {"huge"},
    "Trace.without_displacements_at.steps": {"array", "[1, 2]", *EMPTY},
    "ViewClusterer.isolated": {"3.5", "huge"},
    "ViewClusterer.k_max": {"huge"},
    "World.clearance.x": {"3.5", "-1"},
    "World.clearance.y": {"3.5", "-1"},
    "World.holds.x": {"3.5", "-1"},
    "World.holds.y": {"3.5", "-1"},
    "World.lift_at.x": {"3.5", "-1"},
    "World.lift_at.y": {"3.5", "-1"},
    "World.nearest.pose": {"array"},
    "World.start": {"array"},
    "World.reach": {"3.5"},
    "World.with_choices.reach": {"3.5"},
    "World.places": {"dict"},
    "World.via": {"dict"},
    **{f"World.{members}": EMPTY for members in ("clutter", "route", "dstates", "lifts")},
    "export_map.name": {"nonsense", "null character", "folder"},
    "export_map.frame": {"nonsense", "null character", "folder"},
    "recogniser.floor": {"3.5", "huge"},
    "tour.apart": {"3.5"},
    "tour.bend": {"-1"},
    "tour.scale": {"-1"},
}
# Only the package makes these values, so their constructors check nothing. Their methods are
# tested.
MADE_BY_THE_PACKAGE = {
    "Corrections",
    "Name",
    "Naming",
    "Passage",
    "Said",
    "DrivePair",
    "Drive",
    "Fault",
    "MapPath",
    "Region",
    "Star",
    *(
        "Solution",
        "Status",
        "Cost",
        "Bound",
        "Certificate",
        "Level",
        "Progress",
        "Backbone",
        "SSHMap",
        "DState",
        "Path",
        "Pose",
        "Fit",
    ),
    *(
        "Comparison",
        "Difference",
        "Listing",
        "Page",
        "Evaluation",
        "MapEvaluation",
        "VisitsEvaluation",
        "Rung",
        "Route",
        "Move",
        "Belief",
    ),
    *("Experiment", "Exploration"),
}
# Images are checked by scikit-learn, whose errors are ValueErrors and TypeErrors by convention.
OF_SCIKIT_LEARN = {
    f"{name}.X" for name in ("BootstrapLearner.predict", "BootstrapLearner.score")
} | {f"ViewClusterer.{name}.X" for name in ("fit", "predict", "score")}
SEARCHES = ("solve", "explain_pair", "explain_place", "explain_trace")


class Ring:
    """A robot in a ring of two rooms."""

    at = 0

    def look(self) -> Step:
        return Step(["door", "wall"][self.at], truth=self.at)

    def can(self) -> list[str]:
        return ["on"]

    def do(self, action: Action) -> None:
        self.at = 1 - self.at


@cache
def known() -> dict[str, Any]:
    """A small trace and everything that is made from it."""
    trace = Trace.from_steps(
        ["end", "hall", "end", "hall", "end"],
        ["travel", "travel", "around", "travel"],
        displacements=[(5, 0, 0), (5, 0, 0), (0, 0, 3.14), (5, 0, 0)],
    )
    told = [
        replace(s, truth={"dstate": i, "place": i, "pose": [0.0, float(i), 0.0]})
        for i, s in enumerate(trace.steps)
    ]
    trace = replace(trace, steps=tuple(told))
    solution = solve(trace)
    world = World.named("notched-rectangle")
    drive = simulate(world).without_displacements()
    rng = np.random.default_rng(0)
    images = np.concatenate([rng.normal(centre, 0.1, (4, 3)) for centre in (0, 2, 5)])
    return {
        "trace": trace,
        "solution": solution,
        "map": solution.maps[0],
        "world": world,
        "drive": drive,
        "images": images,
        "plan": Plan(
            "plan",
            (Room("a", "room", (0.0, 0.0)), Room("b", "room", (5.0, 0.0))),
            (Door((0, 1), (2.5, 0.0)),),
        ),
        "learner": BootstrapLearner(
            Theory.causal(), ViewClusterer(3, n_init=1, random_state=0)
        ).fit(drive),
        "clusterer": ViewClusterer(3, random_state=0).fit(images),
        "localiser": Localiser(solution.maps[0]),
        "mapper": OnlineMapper("end", Theory.causal()),
        "search": ended(Search(trace)),
        "experiment": next_experiment(solution, trace),
        "listing": Listing.of(solution),
        "comparison": compare(solution),
        "plain": Trace.from_steps(["a", "b", "a", "c"], ["travel"] * 3),
    }


def ended(search: Search) -> Search:
    for _ in search:
        pass
    return search


def receiver(name: str) -> Any:
    """An object of a class, to call its methods."""
    made = known()
    solution, trace, ssh_map = made["solution"], made["trace"], made["map"]
    return {
        "Action": lambda: Action("travel", "travel"),
        "Backbone": lambda: solution.backbone,
        "Belief": lambda: made["localiser"].prior,
        "BootstrapLearner": lambda: made["learner"],
        "Bound": lambda: solution.bound,
        "Certificate": lambda: solution.certificate,
        "Chances": Chances,
        "Comparison": lambda: made["comparison"],
        "Corrections": lambda: Corrections.for_drives(trace),
        "Cost": lambda: solution.cost,
        "Difference": lambda: difference(ssh_map, ssh_map),
        "Evaluation": lambda: evaluate(solution.maps, trace),
        "Experiment": lambda: made["experiment"],
        "Exploration": lambda: Explorer(Ring(), Theory.causal()).result,
        "Explorer": lambda: Explorer(Ring(), Theory.causal()),
        "Fit": lambda: ssh_map.fit,
        "MapPath": lambda: ssh_map.paths[0],
        "Level": lambda: Level(solution.cost, 1),
        "Listing": lambda: made["listing"],
        "Localiser": lambda: made["localiser"],
        "MapEvaluation": lambda: evaluate(solution.maps, trace).maps[0],
        "Move": lambda: route(solution, 0, 1).moves[0],
        "Odometry": Odometry,
        "OnlineMapper": lambda: made["mapper"],
        "Page": lambda: view_page(solution),
        "Plan": lambda: made["plan"],
        "Route": lambda: route(solution, 0, 1),
        "SSHMap": lambda: ssh_map,
        "Search": lambda: made["search"],
        "Solution": lambda: solution,
        "Speedups": Speedups,
        "Step": lambda: trace.steps[1],
        "Theory": Theory,
        "Trace": lambda: trace,
        "ViewClusterer": lambda: made["clusterer"],
        "VisitsEvaluation": lambda: evaluate_visits(solution.maps, trace),
        "World": lambda: made["world"],
    }[name]()


def good(call: str, parameter: inspect.Parameter) -> Any:
    """A right value for a parameter: for this call, for any call with a parameter of this name, or
    the default."""
    made = known()
    solution, trace, ssh_map, world = made["solution"], made["trace"], made["map"], made["world"]
    of_call: dict[str, Any] = {
        "Action.name": "travel",
        "Action.of.value": "travel",
        "Backbone.from_dict.data": solution.backbone.to_dict(),
        "Backbone.from_dict.steps": len(trace),
        "BootstrapLearner.clusterer": ViewClusterer(3, n_init=1, random_state=0),
        "BootstrapLearner.fit.X": made["drive"],
        "BootstrapLearner.predict.X": made["drive"],
        "BootstrapLearner.score.X": made["drive"],
        "BootstrapLearner.theory": Theory.causal(),
        "Corrections.check_drives.known": {"drive 1": None},
        "Corrections.with_gateway.is_open": False,
        "Corrections.with_gateway.seen": [("monday:1", 90.0)],
        "Corrections.with_name.kind": "place",
        "Corrections.with_name.step": "monday:1",
        "Corrections.with_pair.first": "monday:1",
        "Corrections.with_pair.kind": "same",
        "Corrections.with_pair.second": "monday:2",
        "Corrections.without.sentence": Said("same", ("monday:1", "monday:2")),
        "load_corrections.path": "corrections.yaml",
        "save_corrections.corrections": Corrections.for_drives(trace),
        "SSHMap.called.kind": "place",
        "SSHMap.name_of.kind": "place",
        "SSHMap.numbered.kind": "place",
        "Explorer.explore.steps": 2,
        "Explorer.margin": 0,
        "Explorer.theory": Theory.causal(),
        "Listing.check_same_trace.other": made["listing"],
        "Listing.from_dict.data": solution.to_dict(),
        "Listing.load.path": "solution.json",
        "Listing.named_beside.path": "solution.json",
        "Listing.number.name": "1",
        "Listing.of.source": solution,
        "OnlineMapper.theory": Theory.causal(),
        "Odometry.of.value": {},
        "Plan.doors": made["plan"].doors,
        "Plan.load.path": "plan.xml",
        "Plan.rooms": made["plan"].rooms,
        "SSHMap.from_dict.data": ssh_map.to_dict(),
        "SSHMap.load.path": "map.json",
        "SSHMap.right_of.direction": 1,
        "SSHMap.right_of.path": 0,
        "Closure.covariance": np.eye(3),
        "Closure.of.value": Closure(0, 1, (0.0, 0.0, 0.0), tuple(map(tuple, np.eye(3)))),
        "Search.solution.maps": solution.maps,
        "Solution.from_dict.data": solution.to_dict(),
        "Solution.load.path": "solution.json",
        "Speedups.without.names": "names",
        "Theory.from_dict.data": {},
        "Theory.from_toml.path": "theory.toml",
        "Theory.lack_of.step": replace(trace.steps[1], star=(1, 0, 1, 0)),
        "Trace.from_steps.actions": ["travel"],
        "Trace.from_steps.views": ["a", "b"],
        "Trace.load.path": "trace.jsonl",
        "Trace.prefix.steps": 2,
        "Trace.steps": trace.steps,
        "Trace.with_views.views": trace.views,
        "Trace.without_displacements_at.steps": [1],
        "World.from_occupancy.path": "world.yaml",
        "World.load.path": str(SHIPPED),
        "World.named.name": "notched-rectangle",
        "ViewClusterer.k_max": 3,
        "ViewClusterer.n_init": 1,
        "difference.first": ssh_map,
        "difference.other": ssh_map,
        "evaluate.maps": solution.maps,
        "evaluate_visits.maps": solution.maps,
        "explain_place.place": 0,
        # Without displacements, each search takes a quarter of the time.
        **{f"{call}.trace": made["plain"] for call in SEARCHES},
        "together.traces": [trace],
        "tour.steps": 2,
        "compare.maps": solution,
        "next_experiment.maps": solution,
        "route.maps": solution,
        "find_backbone.solution": solution,
        "view_page.source": solution,
    }
    by_name: dict[str, Any] = {
        "X": made["images"],
        "action": "travel",
        "belief": made["localiser"].prior,
        "displacement": (1.0, 0.0, 0.0),
        "first": 0,
        "goal": 1,
        "hour": 12.0,
        "key": ("wall", 1),
        "last": 1,
        "kind": "misread",
        "least": 0.1,
        "number": 0,
        "drives": drives_of(trace),
        "length": 2,
        "listing": made["listing"],
        "name": "name",
        "path": "written",
        "place": 0,
        "plan": made["plan"],
        "pose": (1.0, 1.0, 0.0),
        "rng": np.random.default_rng(0),
        "robot": Ring(),
        "second": 1,
        "segments": world.segments,
        "share": 0.5,
        "ssh_map": ssh_map,
        "start": 0,
        "step": 1,
        "stopped": "time limit",
        "sure": 0.5,
        "theory": Theory(),
        "to": "nav2",
        "trace": trace,
        "view": "end",
        "walls": 4,
        "where": "here",
        "world": world,
        "x": 1.0,
        "y": 1.0,
        "laser": Laser(),
    }
    key = f"{call}.{parameter.name}"
    if key in of_call:
        return of_call[key]
    if parameter.default is not inspect.Parameter.empty:
        return parameter.default
    if key == "Theory.fault_tenths.step":
        return trace.steps[1]
    return by_name[parameter.name]


# They need a log or its scans: tests/test_log_maps.py and tests/test_log_mapper.py.
NEED_LOGS = {"map_log", "read_log", "OnlineLogMapper", "solved"}


def calls() -> Iterator[tuple[str, Any]]:
    """The public functions, constructors and methods, by name.

    Errors and enumerations are left out.
    """
    for path in itertools.chain.from_iterable(hooks.themes().values()):
        found = hooks.named(path)
        if not inspect.isclass(found):
            if found.__name__ not in NEED_LOGS:
                yield found.__name__, found
            continue
        if found.__name__ in NEED_LOGS:
            continue
        if issubclass(found, BaseException):
            continue
        if found.__name__ not in MADE_BY_THE_PACKAGE:
            yield found.__name__, found
        for name in dir(found) if found.__name__ != "Star" else ():
            home = next((c for c in found.__mro__ if name in c.__dict__), object)
            ours = home.__module__.partition(".")[0] in ("ssh_abduction", "perception", "simulator")
            held = inspect.getattr_static(found, name)
            if (
                ours
                and not name.startswith("_")
                and (isinstance(held, staticmethod | classmethod) or inspect.isfunction(held))
            ):
                yield f"{found.__name__}.{name}", getattr(found, name)


def parameters(function: Any) -> list[inspect.Parameter]:
    found = inspect.signature(function).parameters.values()
    anything = [p for p in found if p.name in ANYTHING and p.default is None]
    return [
        p
        for p in found
        if not p.name.startswith("_")
        and p.name != "self"
        and p not in anything
        and p.kind not in (p.VAR_KEYWORD, p.VAR_POSITIONAL)
    ]


def do(call: str, function: Any, arguments: dict[str, Any]) -> None:
    """Call a function and use its result, because checks may come with the first use: fit
    estimators, and start generators."""
    if "self" in inspect.signature(function).parameters:
        result = function(receiver(call.partition(".")[0]), **arguments)
    else:
        result = function(**arguments)
    if call == "BootstrapLearner":
        result.fit(known()["drive"])
    elif call in ("ViewClusterer", "recogniser"):
        result.fit(known()["images"], [0, 1] * 6)
    elif inspect.isgenerator(result):
        next(result, None)


@pytest.fixture(scope="module", autouse=True)
def _temporary_folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("calls"))
        made = known()
        made["trace"].save("trace.jsonl")
        made["map"].save("map.json")
        made["solution"].save("solution.json")
        save_corrections(Corrections.for_drives(made["trace"]), "corrections.yaml")
        Path("theory.toml").write_text('star = "none"')
        yield


SWEPT = [(call, function) for call, function in calls() if parameters(function)]


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(("call", "function"), SWEPT, ids=[call for call, _ in SWEPT])
def test_wrong_arguments_are_refused_by_errors_of_the_package(call: str, function: Any) -> None:
    wrong: list[str] = []
    right = {p.name: good(call, p) for p in parameters(function)}
    for parameter in parameters(function):
        key = f"{call}.{parameter.name}"
        allowed = RIGHT.get(key, RIGHT_BY_NAME.get(parameter.name, set())) | (
            {"None"} if parameter.default is None else set()
        )
        allowed |= (
            {"True"}
            if isinstance(parameter.default, bool) or "bool" in str(parameter.annotation)
            else set()
        )
        allowed |= {"3.5"} if call == "Odometry" and parameter.name != "extra" else set()
        for name, make in WRONG.items():
            if name == "None" and right[parameter.name] is None:
                continue  # the next test makes this call
            try:
                with contextlib.redirect_stderr(io.StringIO()):
                    do(call, function, {**right, parameter.name: make()})
            except AbductionError as error:
                if name in RIGHT.get(key, ()):
                    wrong.append(f"{key} = {name}: expected to be accepted, got {error}")
            except Exception as error:
                if not (key in OF_SCIKIT_LEARN and isinstance(error, ValueError | TypeError)):
                    wrong.append(f"{key} = {name}: {type(error).__name__}: {error}")
            else:
                if name not in allowed:
                    wrong.append(f"{key} = {name}: accepted")
            finally:
                Path("nonsense").unlink(missing_ok=True)
    assert not wrong, "\n".join(wrong)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("call", [call for call, _ in SWEPT])
def test_right_arguments_are_accepted(call: str) -> None:
    """A call that always fails would pass the tests above. Two calls need files that tests lack."""
    if call == "to_pandas":
        pytest.importorskip("pandas")
    function = dict(SWEPT)[call]
    if call not in ("Plan.load", "World.from_occupancy", "BootstrapLearner.score"):
        do(call, function, {p.name: good(call, p) for p in parameters(function)})
