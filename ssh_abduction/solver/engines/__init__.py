"""Engines, which ask clingo for maps of a growing prefix of a trace."""
