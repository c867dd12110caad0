"""From what a robot saw and did, find the map: every minimal topological map of distinctive states, places and paths.

A name is loaded when it is first used: so the command line begins at once, and hears Ctrl-C from then on. Nothing is imported before
`__main__` has put the current folder behind Python's own modules, not even `__future__`.
"""

TYPE_CHECKING = False  # as in typing, which takes longer to load than all that is here

if TYPE_CHECKING:
    from typing import Any

    from ssh_abduction.data.errors import LocaliserError, MapError, RangeError, SolverError, SSHError, TheoryError, TraceError
    from ssh_abduction.data.maps import DState, Fit, Path, Pose, SSHMap
    from ssh_abduction.data.odometry import Odometry
    from ssh_abduction.data.trace import Action, Step, Trace
    from ssh_abduction.evaluation import Evaluation, MapEvaluation, VisitsEvaluation, evaluate, evaluate_visits
    from ssh_abduction.evaluation.ladder import Rung, ladder
    from ssh_abduction.online.explorer import Exploration, Explorer
    from ssh_abduction.online.localize import Belief, Chances, Localiser
    from ssh_abduction.online.mapper import OnlineMapper
    from ssh_abduction.online.routes import Move, Route, route
    from ssh_abduction.output.export.formats import export_map
    from ssh_abduction.page.html import Page, view_page
    from ssh_abduction.rivals.compare import Comparison, compare
    from ssh_abduction.rivals.difference import Difference, difference
    from ssh_abduction.rivals.explore import Experiment, next_experiment
    from ssh_abduction.rivals.listing import Listing
    from ssh_abduction.solver.engines.base import Cost
    from ssh_abduction.solver.result import Bound, Level, Progress, Solution, Status
    from ssh_abduction.solver.search import Search, solve
    from ssh_abduction.solver.sharing import Backbone
    from ssh_abduction.solver.steps.certificate import Certificate
    from ssh_abduction.theory.speedups import Speedups
    from ssh_abduction.theory.theory import Theory

    __version__: str

_HOMES = {  # module: the names that it exports
    "solver.engines.base": ("Cost",),
    "data.errors": ("LocaliserError", "MapError", "RangeError", "SSHError", "SolverError", "TheoryError", "TraceError"),
    "evaluation": ("Evaluation", "MapEvaluation", "VisitsEvaluation", "evaluate", "evaluate_visits"),
    "output.export.formats": ("export_map",),
    "online.explorer": ("Exploration", "Explorer"),
    "online.localize": ("Belief", "Chances", "Localiser"),
    "data.maps": ("DState", "Fit", "Path", "Pose", "SSHMap"),
    "data.odometry": ("Odometry",),
    "online.mapper": ("OnlineMapper",),
    "rivals.compare": ("Comparison", "compare"),
    "rivals.difference": ("Difference", "difference"),
    "rivals.listing": ("Listing",),
    "page.html": ("Page", "view_page"),
    "rivals.explore": ("Experiment", "next_experiment"),
    "online.routes": ("Move", "Route", "route"),
    "evaluation.ladder": ("Rung", "ladder"),
    "solver.result": ("Bound", "Level", "Progress", "Solution", "Status"),
    "solver.search": ("Search", "solve"),
    "solver.sharing": ("Backbone",),
    "solver.steps.certificate": ("Certificate",),
    "theory.speedups": ("Speedups",),
    "theory.theory": ("Theory",),
    "data.trace": ("Action", "Step", "Trace"),
}

__all__ = [
    "Action",
    "Backbone",
    "Belief",
    "Bound",
    "Certificate",
    "Chances",
    "Comparison",
    "Cost",
    "DState",
    "Difference",
    "Evaluation",
    "Experiment",
    "Exploration",
    "Explorer",
    "Fit",
    "Level",
    "Listing",
    "Localiser",
    "LocaliserError",
    "MapError",
    "MapEvaluation",
    "Move",
    "Odometry",
    "OnlineMapper",
    "Page",
    "Path",
    "Pose",
    "Progress",
    "RangeError",
    "Route",
    "Rung",
    "SSHError",
    "SSHMap",
    "Search",
    "Solution",
    "SolverError",
    "Speedups",
    "Status",
    "Step",
    "Theory",
    "TheoryError",
    "Trace",
    "TraceError",
    "VisitsEvaluation",
    "compare",
    "difference",
    "evaluate",
    "evaluate_visits",
    "export_map",
    "ladder",
    "next_experiment",
    "route",
    "solve",
    "view_page",
]


def __getattr__(name: str) -> "Any":
    import importlib

    if name == "__version__":
        from importlib.metadata import version

        globals()[name] = version("ssh-abduction")
        return globals()[name]
    for module, names in _HOMES.items():
        if name in names:
            value = getattr(importlib.import_module(f"{__name__}.{module}"), name)
            globals()[name] = value
            return value
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__, "__version__"})
