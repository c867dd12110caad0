"""Maps made without clingo. Nothing in here has to be right: what comes of it passes the checker or an encoding."""
