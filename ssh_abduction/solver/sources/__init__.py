"""Sources of maps and of lower bounds on their cost."""
