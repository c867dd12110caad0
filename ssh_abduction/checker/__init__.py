"""Check maps and lower bounds in plain Python, without the encodings and the solver."""

from ssh_abduction.checker.checker import check

__all__ = ["check"]
