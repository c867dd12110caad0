"""Support for running programs: start and exit, time limits, the log, and deprecated names.

This module imports nothing, because `__main__` loads `program` before any other module.
"""
