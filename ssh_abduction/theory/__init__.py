"""Theories: sets of axioms, the encodings of the axioms, and the speed-ups that a theory allows."""

from ssh_abduction.theory.fields import CAUSAL, CHOICES, COUNTS, Count
from ssh_abduction.theory.speedups import Speedups
from ssh_abduction.theory.theory import PRESETS, Theory

__all__ = ["CAUSAL", "CHOICES", "COUNTS", "PRESETS", "Count", "Speedups", "Theory"]
