"""The package's log: `logging.getLogger("ssh_abduction")` and the loggers below it.

It is silent unless a program asks for it (`logging.basicConfig`, or `-v` in the shell). Messages
are sentences for people and may change. INFO says what a search begins, finds and proves. DEBUG
says what clingo gets.

>>> log_of("ssh_abduction.solver.search").name, PROGRESS.name
('ssh_abduction.solver.search', 'ssh_abduction.progress')
"""

from __future__ import annotations

import logging

PACKAGE = "ssh_abduction"
logging.getLogger(PACKAGE).addHandler(logging.NullHandler())
# Progress of a search: INFO if it knows more than before, DEBUG now and then.
PROGRESS = logging.getLogger(f"{PACKAGE}.progress")


def log_of(module: str) -> logging.Logger:
    """The logger of a module of this package, by its `__name__`."""
    return logging.getLogger(module)
