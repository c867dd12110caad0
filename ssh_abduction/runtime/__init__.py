"""Support for running programs: start and exit, lazy names, limits, the log, threads, old names.

This module imports nothing, because `lazy` and `program` are loaded before any other module.
"""
