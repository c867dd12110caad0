"""The package's log: `logging.getLogger("ssh_abduction")` and the loggers below it.

It is silent unless a program calls `logging.basicConfig`, or a user gives `-v` in the shell.
Messages are sentences for people and may change. INFO messages say what a search begins, finds and
proves. DEBUG messages say what clingo gets.

>>> log_of("ssh_abduction.solver.search").name, PROGRESS.name
('ssh_abduction.solver.search', 'ssh_abduction.progress')
"""

from __future__ import annotations

import logging

PACKAGE = "ssh_abduction"
logging.getLogger(PACKAGE).addHandler(logging.NullHandler())
# Progress of a search: INFO if the best cost or the bound has changed, DEBUG otherwise.
PROGRESS = logging.getLogger(f"{PACKAGE}.progress")


def log_of(module: str) -> logging.Logger:
    """Return the logger of a module of this package."""
    return logging.getLogger(module)
