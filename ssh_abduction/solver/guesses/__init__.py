"""Guesses at maps without clingo. They may be wrong: the checker or an encoding tests them."""
