"""From what a robot saw and did, find the map: every minimal map of distinctive states, places and paths."""

from ssh_abduction.engines.base import Cost
from ssh_abduction.errors import MapError, SolverError, SSHError, TheoryError, TraceError
from ssh_abduction.maps import DState, Path, SSHMap
from ssh_abduction.online.mapper import OnlineMapper
from ssh_abduction.solver.search import Bound, Progress, Search, Solution, Status, solve
from ssh_abduction.steps.certificate import Certificate
from ssh_abduction.theory.speedups import Speedups
from ssh_abduction.theory.theory import Theory
from ssh_abduction.trace import Action, Step, Trace

__all__ = [
    "Action",
    "Bound",
    "Certificate",
    "Cost",
    "DState",
    "MapError",
    "OnlineMapper",
    "Path",
    "Progress",
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
    "solve",
]
