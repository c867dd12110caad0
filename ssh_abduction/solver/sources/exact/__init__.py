"""Find minimal maps with clingo, and prove that they are minimal."""
