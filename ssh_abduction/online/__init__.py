"""The minimal maps of a trace that grows."""

from ssh_abduction.online.mapper import OnlineMapper

__all__ = ["OnlineMapper"]
