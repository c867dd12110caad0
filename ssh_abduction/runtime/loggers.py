"""The package's log: `logging.getLogger("ssh_abduction")` and the loggers below it.

It is silent unless a program calls `logging.basicConfig`, or a user gives `-v` in the shell.
Messages are sentences for people and may change. INFO messages say what a search begins, finds and
proves. DEBUG messages say what clingo gets.

>>> log_of("ssh_abduction.solver.search").name, PROGRESS.name
('ssh_abduction.solver.search', 'ssh_abduction.progress')
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager

PACKAGE = "ssh_abduction"
logging.getLogger(PACKAGE).addHandler(logging.NullHandler())
# Progress of a search: INFO if the best cost or the bound has changed, DEBUG otherwise.
PROGRESS = logging.getLogger(f"{PACKAGE}.progress")


class _Stages:
    """The stages of the command that runs, and how many of them have begun."""

    names: tuple[str, ...] = ()
    begun = 0


@contextmanager
def stages(*names: str) -> Iterator[None]:
    """Until the block ends, lines of progress say which of these stages of a command runs."""
    before, _Stages.names, _Stages.begun = (_Stages.names, _Stages.begun), names, 0
    begin_stage(names[0])
    try:
        yield
    finally:
        _Stages.names, _Stages.begun = before


def begin_stage(name: str) -> None:
    """Log that a stage begins. Without such a stage ahead, it is a part of the present one."""
    if name in _Stages.names[_Stages.begun :]:
        _Stages.begun = _Stages.names.index(name) + 1
        log_progress("", logging.INFO)
    else:
        log_progress(name, logging.INFO)


def log_progress(text: str, level: int = logging.DEBUG) -> None:
    """Log how far the present stage is: "3 of 6, search: 12 of 73 units, best 50 places"."""
    if _Stages.begun:
        stage = f"{_Stages.begun} of {len(_Stages.names)}, {_Stages.names[_Stages.begun - 1]}"
        text = f"{stage}: {text}" if text else stage
    PROGRESS.log(level, "%s", text)


def log_of(module: str) -> logging.Logger:
    """Return the logger of a module of this package."""
    return logging.getLogger(module)
