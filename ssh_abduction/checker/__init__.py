"""Check maps and lower bounds in plain Python, without the encodings and the solver."""

from ssh_abduction.checker.checker import Violation, check
from ssh_abduction.checker.claims import check_bound

__all__ = ["Violation", "check", "check_bound"]
