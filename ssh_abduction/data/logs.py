"""The package's log: `logging.getLogger("ssh_abduction")` and the loggers below it. Silent, unless a program asks (`logging.basicConfig`, or `-v` in the shell).

Its messages are sentences for people, and no interface. INFO says what a search begins, finds and proves; DEBUG says what is given to clingo.

>>> log_of("ssh_abduction.solver.search").name, PROGRESS.name
('ssh_abduction.solver.search', 'ssh_abduction.progress')
"""

from __future__ import annotations

import logging

PACKAGE = "ssh_abduction"
logging.getLogger(PACKAGE).addHandler(logging.NullHandler())
# How far a search is: at INFO where it knows more than before, at DEBUG now and then.
PROGRESS = logging.getLogger(f"{PACKAGE}.progress")


def log_of(module: str) -> logging.Logger:
    """The logger of a module of this package, by its `__name__`."""
    return logging.getLogger(module)
