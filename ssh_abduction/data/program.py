"""How a program of this package starts and ends: where its processes look for modules, and which exit code a signal gives.

It loads nothing that is not there when Python begins, so that a file in the current folder cannot take the place of a module of Python's.
"""

import os
import sys

# The exit code of a shell for a signal is this plus the number of the signal. Ctrl-C is signal 2 everywhere.
SIGNALLED, CTRL_C = 128, 2

heard: list[int] = []  # the signals that asked this process to end, in their order
raised: list[int] = []  # those of them that became a KeyboardInterrupt

_PACKAGE = os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__))))

# What a new process runs first, as `python -P -c`. The option -P keeps the current folder off the path; the path of the process that began it comes next.
_START = (
    "import pickle, sys; sys.path[:] = pickle.load(sys.stdin.buffer); from {} import serve; serve()"
)


def interrupted_code() -> int:
    """The exit code of a program that a signal ended: 130 after Ctrl-C, 143 after SIGTERM."""
    return SIGNALLED + (heard[-1] if heard else CTRL_C)


def command(module: str) -> list[str]:
    """The command that starts a process which calls `serve` of a module. Its input begins with `search_path`, pickled."""
    return [sys.executable, "-P", "-c", _START.format(module)]


def search_path() -> list[str]:
    """Where modules are looked for, with the current folder last, so that no file there is taken for a module of Python's or of a library.

    The order stays as it is where the current folder is the one that this package lies in, as in a checkout.
    """
    try:
        current = os.path.realpath(os.getcwd())
    except OSError:  # the current folder was deleted
        return list(sys.path)
    if current == os.path.realpath(_PACKAGE):
        return list(sys.path)
    return sorted(sys.path, key=lambda folder: os.path.realpath(folder) == current)
