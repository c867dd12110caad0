"""Find every minimal topological map that explains what a robot saw and did.

Each exported name is loaded when it is first used. So the command line starts at once, and Ctrl-C
works from its start. When this module is loaded, it imports `sys`, which is part of Python itself,
and `lazy`, but not even `__future__`. At that time, Python may still search the current folder
first, and a file there could replace a module of Python. `__main__` moves that folder to the end of
the search path.
"""

import sys

from ssh_abduction.runtime.lazy import lazy_names

TYPE_CHECKING = False  # as in typing, which takes longer to load than this whole module

if TYPE_CHECKING:
    from typing import Any

    from ssh_abduction.checker import check as check
    from ssh_abduction.data import AbductionError as AbductionError
    from ssh_abduction.data import SSHMap as SSHMap
    from ssh_abduction.data import Trace as Trace
    from ssh_abduction.evaluation import evaluate as evaluate
    from ssh_abduction.explain import explain_pair as explain_pair
    from ssh_abduction.explain import explain_trace as explain_trace
    from ssh_abduction.learning import BootstrapLearner as BootstrapLearner
    from ssh_abduction.online import Explorer as Explorer
    from ssh_abduction.online import Localiser as Localiser
    from ssh_abduction.online import OnlineMapper as OnlineMapper
    from ssh_abduction.online import route as route
    from ssh_abduction.output import export_map as export_map
    from ssh_abduction.page import view_page as view_page
    from ssh_abduction.rivals import compare as compare
    from ssh_abduction.rivals import next_experiment as next_experiment
    from ssh_abduction.robot_logs import map_log as map_log
    from ssh_abduction.solver import Solution as Solution
    from ssh_abduction.solver import solve as solve
    from ssh_abduction.theory import Theory as Theory

    __version__: str

# Names of version 0.1.0. Each still works in this version, with a warning that gives its new home.
_MOVED = {"Path": "data.MapPath", "SSHError": "data.AbductionError"} | {
    name: f"{home}.{name}"
    for home, names in {
        "data": "Action DState Fit LocaliserError MapError Odometry Pose RangeError SolverError "
        "Step TheoryError TraceError",
        "evaluation": "Evaluation MapEvaluation VisitsEvaluation evaluate_visits",
        "evaluation.rungs": "Rung ladder",
        "online": "Belief Chances Exploration Move Route",
        "page": "Page",
        "rivals": "Comparison Difference Experiment Listing difference",
        "solver": "Backbone Bound Certificate Cost Level Progress Search Status",
        "theory": "Speedups",
    }.items()
    for name in names.split()
}

# Modules whose names the documentation of version 0.1.0 imports, and the packages of these names.
_MOVED_MODULES = {
    "ssh_abduction.front": "ssh_abduction.solver",
    "ssh_abduction.learner": "ssh_abduction.learning",
    "ssh_abduction.rivals.explain": "ssh_abduction.explain",
}


class _MovedModules:
    """Finds and loads the modules of version 0.1.0 that other packages have replaced."""

    def find_spec(self, name: str, *_: object) -> "Any":
        if name not in _MOVED_MODULES:
            return None
        from importlib.machinery import ModuleSpec

        loader: Any = self
        return ModuleSpec(name, loader)

    def create_module(self, spec: "Any") -> None:
        """Let Python make an empty module, which `exec_module` replaces."""

    def exec_module(self, module: "Any") -> None:
        import warnings
        from importlib import import_module

        old, now = module.__name__, _MOVED_MODULES[module.__name__]
        warnings.warn(f"{old} is deprecated; use {now}", DeprecationWarning, stacklevel=2)
        sys.modules[old] = import_module(now)


sys.meta_path.append(_MovedModules())
_load, __dir__ = lazy_names(__name__)


def __getattr__(name: str) -> "Any":
    if name == "__version__":
        from importlib.metadata import version

        globals()[name] = version("ssh-abduction")
        return globals()[name]
    if name in _MOVED:
        import warnings
        from importlib import import_module

        package, _, now = _MOVED[name].rpartition(".")
        warnings.warn(
            f"ssh_abduction.{name} is deprecated; use ssh_abduction.{package}.{now}",
            DeprecationWarning,
            stacklevel=2,
        )
        return getattr(import_module(f"{__name__}.{package}"), now)
    return _load(name)
