"""The minimal maps of a trace that grows."""
