"""Guesses of maps, made without clingo. A guess may be wrong, so the caller has to check it."""
