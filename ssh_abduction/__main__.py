"""The command line as a program. It loads nothing until it knows what Ctrl-C is to do."""

from __future__ import annotations

import os
import sys

INTERRUPTED = 130  # the exit code of a program that Ctrl-C ended

try:
    import signal
except KeyboardInterrupt:
    os._exit(INTERRUPTED)

TYPE_CHECKING = False  # as in typing, which takes longer to load than all that is here

if TYPE_CHECKING:
    from types import FrameType
    from typing import NoReturn


def run() -> NoReturn:
    """Run the command line and exit with its code; with 130, and without a traceback, after Ctrl-C at any time."""
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:  # as in the background of some shells
        signal.signal(signal.SIGINT, _interrupt)
    try:
        from ssh_abduction.cli import main

        code = main()
        if signal.getsignal(signal.SIGINT) is _interrupt:
            signal.signal(signal.SIGINT, _end)
    except KeyboardInterrupt:
        _end()
    sys.exit(code)


def _interrupt(number: int, frame: FrameType | None) -> None:
    """Ctrl-C is a KeyboardInterrupt, but while a module is loaded it ends the program at once.

    Nothing is lost by that; and what is written in C, such as numpy, prints a traceback or makes another error of a KeyboardInterrupt.
    """
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            _end()
        frame = frame.f_back
    raise KeyboardInterrupt


def _end(*_: object) -> NoReturn:
    os._exit(INTERRUPTED)


if __name__ == "__main__":
    run()
