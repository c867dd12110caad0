"""Judges of maps and bounds in plain Python, independent of the encodings and the solver."""

from ssh_abduction.checker.checker import Violation, check
from ssh_abduction.checker.proof import check_bound

__all__ = ["Violation", "check", "check_bound"]
