"""Run clingo under limits, give it facts, and read its answers."""
