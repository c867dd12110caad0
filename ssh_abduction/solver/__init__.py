"""Search for every minimal map of a trace.

Other packages import only the names that this module lists.

Each name is loaded when it is first used, so that importing `Solution` does not load clingo.
"""

from ssh_abduction import lazy_names

TYPE_CHECKING = False

if TYPE_CHECKING:
    from ssh_abduction.solver.asp import facts, workers
    from ssh_abduction.solver.asp.control import Control
    from ssh_abduction.solver.asp.limits import (
        POLL,
        LimitError,
        Stop,
        Watch,
        check_limit,
        resident_memory,
    )
    from ssh_abduction.solver.asp.rules import check_rules
    from ssh_abduction.solver.asp.workers import end_all, in_process
    from ssh_abduction.solver.costs.estimating import maps_apart
    from ssh_abduction.solver.costs.misfit import Misfit
    from ssh_abduction.solver.entry import find_backbone, solve
    from ssh_abduction.solver.front import Front, Point, fault_front
    from ssh_abduction.solver.geometry.fit import fit
    from ssh_abduction.solver.geometry.ranking import Ranking
    from ssh_abduction.solver.guesses.gated import sketch_beyond, sketches_of
    from ssh_abduction.solver.guesses.tree import Sketch
    from ssh_abduction.solver.judging import InternalError, Judging
    from ssh_abduction.solver.obeying import obeyed, with_kept_apart, with_names
    from ssh_abduction.solver.regions import find_regions, with_regions
    from ssh_abduction.solver.search import Search
    from ssh_abduction.solver.solution.recorded import (
        drives_in,
        joins_in,
        theory_in,
        trace_in,
        warnings_in,
    )
    from ssh_abduction.solver.solution.result import Solution
    from ssh_abduction.solver.solution.sharing import (
        SORTS,
        Backbone,
        Shared,
        Sharing,
        Sort,
        stretches,
    )
    from ssh_abduction.solver.solution.weighed import EQUAL, Weighed, probability_in_words
    from ssh_abduction.solver.solution.writing import ending, opening, summary_of, written_map
    from ssh_abduction.solver.start import Limits, Start
    from ssh_abduction.solver.steps.certificate import RESTS_ON, Certificate
    from ssh_abduction.solver.steps.log import Outcome, observation
    from ssh_abduction.solver.values import (
        Bound,
        Cost,
        Effort,
        Level,
        Progress,
        Seconds,
        Status,
        cost_as_counted,
    )

__all__ = [
    "EQUAL",
    "POLL",
    "RESTS_ON",
    "SORTS",
    "Backbone",
    "Bound",
    "Certificate",
    "Control",
    "Cost",
    "Effort",
    "Front",
    "InternalError",
    "Judging",
    "Level",
    "LimitError",
    "Limits",
    "Misfit",
    "Outcome",
    "Point",
    "Progress",
    "Ranking",
    "Search",
    "Seconds",
    "Shared",
    "Sharing",
    "Sketch",
    "Solution",
    "Sort",
    "Start",
    "Status",
    "Stop",
    "Watch",
    "Weighed",
    "check_limit",
    "check_rules",
    "cost_as_counted",
    "drives_in",
    "end_all",
    "ending",
    "facts",
    "fault_front",
    "find_backbone",
    "find_regions",
    "fit",
    "in_process",
    "joins_in",
    "maps_apart",
    "obeyed",
    "observation",
    "opening",
    "probability_in_words",
    "resident_memory",
    "sketch_beyond",
    "sketches_of",
    "solve",
    "stretches",
    "summary_of",
    "theory_in",
    "trace_in",
    "warnings_in",
    "with_kept_apart",
    "with_names",
    "with_regions",
    "workers",
    "written_map",
]

__getattr__, __dir__ = lazy_names(__name__, __all__)
