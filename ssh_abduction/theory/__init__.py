"""Theories: which axioms hold, in which encodings they are, and which speed-ups they allow."""

from ssh_abduction.theory.fields import CAUSAL, CHOICES, COUNTS, Count
from ssh_abduction.theory.speedups import Speedups
from ssh_abduction.theory.theory import PRESETS, Theory

__all__ = ["CAUSAL", "CHOICES", "COUNTS", "PRESETS", "Count", "Speedups", "Theory"]
