"""Start and end of programs: the path of modules of their processes, and exit codes of signals.

It imports only what Python has loaded already, so that no file in the current folder can take the
place of a module of Python.
"""

import os
import sys

# The exit code for a signal is SIGNALLED plus its number. Ctrl-C is signal 2 everywhere.
SIGNALLED, CTRL_C = 128, 2

heard: list[int] = []  # the signals that asked this process to end, in order
raised: list[int] = []  # those that raised a KeyboardInterrupt

_PACKAGE = os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__))))

# What a new process runs first, as `python -P -c`. The option -P keeps the current folder off the
# path. Then it gets the path of the process that started it.
_START = (
    "import pickle, sys; sys.path[:] = pickle.load(sys.stdin.buffer); from {} import serve; serve()"
)


def interrupted_code() -> int:
    """The exit code after a signal: 130 for Ctrl-C, 143 for SIGTERM."""
    return SIGNALLED + (heard[-1] if heard else CTRL_C)


def command(module: str) -> list[str]:
    """The command of a process that calls `serve` of a module.

    Its input must begin with `search_path()`, pickled.
    """
    return [sys.executable, "-P", "-c", _START.format(module)]


def search_path() -> list[str]:
    """The path of modules with the current folder last.

    Then no file in this folder is taken for a module of Python or of a library. The order stays in
    a checkout, where this package lies in the current folder.
    """
    try:
        current = os.path.realpath(os.getcwd())
    except OSError:  # the current folder was deleted
        return list(sys.path)
    if current == os.path.realpath(_PACKAGE):
        return list(sys.path)
    return sorted(sys.path, key=lambda folder: os.path.realpath(folder) == current)
