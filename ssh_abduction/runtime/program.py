"""Start and end of processes: where Python looks for modules, and exit codes after signals.

This module imports only modules that Python has already loaded when it starts. So no file in the
current folder can take the place of a module of Python.
"""

import os
import sys
import time

TYPE_CHECKING = False  # as in typing, which takes longer to load than this whole module

if TYPE_CHECKING:
    from types import FrameType

# The exit code for a signal is SIGNALLED plus its number. Ctrl-C is signal 2 everywhere.
SIGNALLED, CTRL_C = 128, 2

# Users press Ctrl-C twice, and `timeout` sends a signal to a process and to its group. So a signal
# this many seconds after the first one asks for nothing new.
AGAIN = 1.5

heard: list[int] = []  # the signals that asked this process to end, in order
raised: list[int] = []  # the signals that raised a KeyboardInterrupt
shown: dict[int, int] = {}  # the exit code that stands for another one, as the user asked
_heard_at: list[float] = []  # when the last signal came that asked for something new

_PACKAGE = os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__))))

# What a new process runs first, as `python -P -c`. The option -P keeps the current folder off
# `sys.path`. Then the process takes over the `sys.path` of the process that started it.
_START = (
    "import pickle, sys; sys.path[:] = pickle.load(sys.stdin.buffer); from {} import serve; serve()"
)


def interrupted_code() -> int:
    """Return the exit code after the last signal: 130 for Ctrl-C (the default), 143 for SIGTERM."""
    return SIGNALLED + (heard[-1] if heard else CTRL_C)


def is_loading(frame: "FrameType | None") -> bool:
    """Whether a module is being loaded in a frame, or in one that called it.

    A KeyboardInterrupt would be unsafe there: C code, such as that of numpy, prints a traceback or
    turns it into another error.
    """
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            return True
        frame = frame.f_back
    return False


def hear(number: int) -> bool:
    """Note a signal. Return False if it soon follows another one, and so asks for nothing new."""
    heard.append(number)
    is_new = not _heard_at or is_again(_heard_at[0])
    if is_new:
        _heard_at[:] = [time.monotonic()]
    return is_new


def is_again(since: float) -> bool:
    """Whether a signal that comes now asks for something new, after one at this monotonic time."""
    return time.monotonic() > since + AGAIN


def forget() -> None:
    """Forget the last signal, as it had no effect."""
    raised.clear()
    _heard_at.clear()


def command(module: str) -> list[str]:
    """Return the command line of a new Python process that calls the function `serve` of a module.

    The standard input of the process must begin with `search_path()`, pickled.
    """
    return [sys.executable, "-P", "-c", _START.format(module)]


def search_path() -> list[str]:
    """Return `sys.path` with the current folder moved to the end.

    So no file in the current folder is loaded in place of a module of Python or of a library. The
    order does not change if the current folder is the checkout that this package is loaded from, or
    if it was deleted.
    """
    try:
        current = os.path.realpath(os.getcwd())
    except OSError:  # the current folder was deleted
        return list(sys.path)
    if current == os.path.realpath(_PACKAGE):
        return list(sys.path)
    return sorted(sys.path, key=lambda folder: os.path.realpath(folder) == current)
