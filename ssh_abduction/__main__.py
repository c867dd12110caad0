"""The command line as a program. It handles Ctrl-C before it loads anything else."""

import os
import sys

from ssh_abduction.runtime import program

# `python -m` puts the current folder first. A file there must not hide a module of Python's.
sys.path[:] = program.search_path()

try:
    import signal
except KeyboardInterrupt:
    os._exit(program.interrupted_code())

TYPE_CHECKING = False  # as in typing, which takes longer to load than all that is here

if TYPE_CHECKING:
    from types import FrameType
    from typing import NoReturn


def run() -> "NoReturn":
    """Run the command line and exit with its code.

    After Ctrl-C at any time the code is 130, after SIGTERM 143, and there is no traceback.
    """
    numbers = [
        number
        for number in (signal.SIGINT, signal.SIGTERM)
        if signal.getsignal(number) is not signal.SIG_IGN
    ]
    for number in numbers:  # some shells let programs in the background ignore Ctrl-C
        signal.signal(number, _interrupt)
    try:
        from ssh_abduction.cli import main

        code = main()
        for number in numbers:
            if signal.getsignal(number) is _interrupt:
                signal.signal(number, _end)
    except KeyboardInterrupt:
        _end()
    sys.exit(code)


def _interrupt(number: int, frame: "FrameType | None") -> None:
    """Ctrl-C is a KeyboardInterrupt, but while a module is loaded it ends the program at once.

    Nothing is lost by that; and what is written in C, such as numpy, prints a traceback or makes
    another error of a KeyboardInterrupt.
    """
    program.heard.append(number)
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            _end()
        frame = frame.f_back
    program.raised.append(number)
    raise KeyboardInterrupt


def _end(number: "int | None" = None, _: object = None) -> "NoReturn":
    if number is not None:
        program.heard.append(number)
    os._exit(program.interrupted_code())


if __name__ == "__main__":
    run()
