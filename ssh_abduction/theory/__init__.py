"""Which axioms hold, where they stand, and which speed-ups they leave on."""

from ssh_abduction.theory.theory import CAUSAL, CHOICES, COUNTS, PRESETS, Count, Theory

__all__ = ["CAUSAL", "CHOICES", "COUNTS", "PRESETS", "Count", "Theory"]
