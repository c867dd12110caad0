"""clingo under limits, and what passes between it and Python."""
