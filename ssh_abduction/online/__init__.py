"""Map while the robot drives, explore, localise in a known map, and plan routes."""

from ssh_abduction.runtime.lazy import lazy_names

TYPE_CHECKING = False

if TYPE_CHECKING:
    from ssh_abduction.online.explorer import Exploration as Exploration
    from ssh_abduction.online.explorer import Explorer as Explorer
    from ssh_abduction.online.localiser import Belief as Belief
    from ssh_abduction.online.localiser import Chances as Chances
    from ssh_abduction.online.localiser import Localiser as Localiser
    from ssh_abduction.online.mapper import OnlineMapper as OnlineMapper
    from ssh_abduction.online.routes import Move as Move
    from ssh_abduction.online.routes import Route as Route
    from ssh_abduction.online.routes import route as route

__getattr__, __dir__ = lazy_names(__name__)
