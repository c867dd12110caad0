"""Which axioms hold, where they stand, and which speed-ups there are."""
