"""Map while the robot drives, explore, localise in a known map, and plan routes."""

from ssh_abduction.online.explorer import Exploration, Explorer
from ssh_abduction.online.localiser import Belief, Chances, Localiser
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
