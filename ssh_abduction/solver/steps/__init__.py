"""A trace as integers, and what follows from it alone."""
