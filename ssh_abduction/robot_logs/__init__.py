"""From a robot's log to the minimal maps of the building, and a report."""

from ssh_abduction.robot_logs.maps import LogMap, map_log

__all__ = ["LogMap", "map_log"]
