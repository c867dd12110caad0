"""Theories: sets of axioms, the encodings of the axioms, and the speed-ups that a theory allows."""

from ssh_abduction.theory.speedups import Speedups
from ssh_abduction.theory.theory import Theory

__all__ = ["Speedups", "Theory"]
