"""Support for running programs: start and exit, time limits, the log, threads, deprecated names.

This module imports nothing, because `__main__` loads `program` before any other module.
"""
