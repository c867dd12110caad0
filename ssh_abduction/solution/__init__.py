"""The answer for one trace: frozen values, with their JSON. They need no solver.

Other packages import only the names that this package lists.

Each name is loaded when it is first used.
"""

from ssh_abduction.runtime.lazy import lazy_names

TYPE_CHECKING = False

if TYPE_CHECKING:
    from ssh_abduction.runtime.limits import Stop as Stop
    from ssh_abduction.solution.certificate import RESTS_ON as RESTS_ON
    from ssh_abduction.solution.certificate import Certificate as Certificate
    from ssh_abduction.solution.corrected import obeyed as obeyed
    from ssh_abduction.solution.corrected import (
        with_correction_warnings as with_correction_warnings,
    )
    from ssh_abduction.solution.corrected import with_names as with_names
    from ssh_abduction.solution.recorded import trace_in as trace_in
    from ssh_abduction.solution.result import Solution as Solution
    from ssh_abduction.solution.result import ending as ending
    from ssh_abduction.solution.result import opening as opening
    from ssh_abduction.solution.result import summary_of as summary_of
    from ssh_abduction.solution.result import verdict_of as verdict_of
    from ssh_abduction.solution.result import written_map as written_map
    from ssh_abduction.solution.sharing import SORTS as SORTS
    from ssh_abduction.solution.sharing import Backbone as Backbone
    from ssh_abduction.solution.sharing import Shared as Shared
    from ssh_abduction.solution.sharing import Sharing as Sharing
    from ssh_abduction.solution.sharing import Sort as Sort
    from ssh_abduction.solution.sharing import key_of as key_of
    from ssh_abduction.solution.sharing import sorts_of as sorts_of
    from ssh_abduction.solution.sharing import steps_in_words as steps_in_words
    from ssh_abduction.solution.sharing import stretches as stretches
    from ssh_abduction.solution.values import Bound as Bound
    from ssh_abduction.solution.values import Cost as Cost
    from ssh_abduction.solution.values import Effort as Effort
    from ssh_abduction.solution.values import Level as Level
    from ssh_abduction.solution.values import Progress as Progress
    from ssh_abduction.solution.values import Seconds as Seconds
    from ssh_abduction.solution.values import Status as Status
    from ssh_abduction.solution.values import cost_as_counted as cost_as_counted
    from ssh_abduction.solution.weighed import EQUAL as EQUAL
    from ssh_abduction.solution.weighed import Weighed as Weighed
    from ssh_abduction.solution.weighed import probability_in_words as probability_in_words

__getattr__, __dir__ = lazy_names(__name__)
