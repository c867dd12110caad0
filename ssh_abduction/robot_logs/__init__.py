"""Map a building from a robot's log, and write a report."""

from ssh_abduction.runtime.lazy import lazy_names

TYPE_CHECKING = False

if TYPE_CHECKING:
    from ssh_abduction.robot_logs.log_maps import map_log as map_log

__getattr__, __dir__ = lazy_names(__name__)
