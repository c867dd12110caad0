"""Find every minimal topological map that explains what a robot saw and did.

Each exported name is loaded when it is first used. So the command line starts at once, and Ctrl-C
works from its start. When this module is loaded, it imports `lazy` alone, not even `__future__`. At
that time, Python may still search the current folder first, and a file there could replace a module
of Python. `__main__` moves that folder to the end of the search path.
"""

from ssh_abduction.runtime.lazy import CARDS, lazy_names

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
    from ssh_abduction.solution import Solution as Solution
    from ssh_abduction.solver import solve as solve
    from ssh_abduction.theory import Theory as Theory

    __version__: str

_load, __dir__ = lazy_names(__name__)
# Values are below the drawing of their cards. So they find it here, and import nothing above them.
CARDS.update(
    SSHMap=("ssh_abduction.output.cards", "map_card"),
    Trace=("ssh_abduction.output.cards", "trace_card"),
)


def __getattr__(name: str) -> "Any":
    if name == "__version__":
        from importlib.metadata import version

        globals()[name] = version("ssh-abduction")
        return globals()[name]
    return _load(name)
