"""Search for every minimal map of a trace.

Other packages import only the names that this module lists.

Each name is loaded when it is first used, so that importing `Solution` does not load clingo.
"""

from ssh_abduction.runtime.lazy import lazy_names

TYPE_CHECKING = False

if TYPE_CHECKING:
    from ssh_abduction.solver.asp import facts as facts
    from ssh_abduction.solver.asp.control import Asker as Asker
    from ssh_abduction.solver.asp.control import Control as Control
    from ssh_abduction.solver.asp.control import new_control as new_control
    from ssh_abduction.solver.asp.kept_rules import check_rules as check_rules
    from ssh_abduction.solver.board import InternalError as InternalError
    from ssh_abduction.solver.board import Judging as Judging
    from ssh_abduction.solver.costs.estimating import maps_apart as maps_apart
    from ssh_abduction.solver.costs.misfit import Misfit as Misfit
    from ssh_abduction.solver.derived_regions import find_regions as find_regions
    from ssh_abduction.solver.derived_regions import with_regions as with_regions
    from ssh_abduction.solver.entry import find_backbone as find_backbone
    from ssh_abduction.solver.entry import solve as solve
    from ssh_abduction.solver.geometry.fit import fit as fit
    from ssh_abduction.solver.geometry.ranking import Ranking as Ranking
    from ssh_abduction.solver.parts import Limits as Limits
    from ssh_abduction.solver.parts import Start as Start
    from ssh_abduction.solver.search import Search as Search
    from ssh_abduction.solver.sources.exact.choosing import preload_engine as preload_engine
    from ssh_abduction.solver.sources.symbolic.sketch import Sketch as Sketch
    from ssh_abduction.solver.sources.symbolic.sketch import sketch_beyond as sketch_beyond
    from ssh_abduction.solver.sources.symbolic.sketch import sketches_of as sketches_of
    from ssh_abduction.solver.steps.log import observation as observation

__getattr__, __dir__ = lazy_names(__name__)
