"""Support for running programs: start and exit, lazy names, limits, the log, threads.

This module imports nothing, because `lazy` and `program` are loaded before any other module.
"""
