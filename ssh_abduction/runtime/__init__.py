"""What programs of this package run on: start and end, the clock, the log, and old names.

This module imports nothing, as `program` is loaded before any other module (see `__main__`).
"""
