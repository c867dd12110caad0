"""The judges of maps and bounds: plain Python that shares nothing with the encodings, so that it can catch them."""

from ssh_abduction.checker.checker import Violation, check
from ssh_abduction.checker.proof import check_bound

__all__ = ["Violation", "check", "check_bound"]
