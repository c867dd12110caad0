"""Every minimal map of a trace."""

from ssh_abduction.solver.result import Bound, Progress, Seconds, Solution, Status
from ssh_abduction.solver.search import Search, solve

__all__ = ["Bound", "Progress", "Search", "Seconds", "Solution", "Status", "solve"]
