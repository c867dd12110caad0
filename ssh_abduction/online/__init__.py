"""Map while the robot drives, explore, localise in a known map, and plan routes."""

from ssh_abduction import lazy_names

TYPE_CHECKING = False

if TYPE_CHECKING:
    from ssh_abduction.online.belief import Belief
    from ssh_abduction.online.chances import Chances
    from ssh_abduction.online.explorer import Exploration, Explorer
    from ssh_abduction.online.localiser import Localiser
    from ssh_abduction.online.mapper import OnlineMapper
    from ssh_abduction.online.routes import Move, Route, route

__all__ = [
    "Belief",
    "Chances",
    "Exploration",
    "Explorer",
    "Localiser",
    "Move",
    "OnlineMapper",
    "Route",
    "route",
]

__getattr__, __dir__ = lazy_names(__name__, __all__)
