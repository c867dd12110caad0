"""The entry point of the command line. It handles Ctrl-C before it loads the other modules."""

import os
import sys

from ssh_abduction.runtime import program

# `python -m` puts the current folder first. A file there must not hide a module of Python.
sys.path[:] = program.search_path()

try:
    import signal
except KeyboardInterrupt:
    os._exit(program.interrupted_code())

TYPE_CHECKING = False  # as in typing, which takes longer to load than this whole module

if TYPE_CHECKING:
    from types import FrameType
    from typing import NoReturn


def run() -> "NoReturn":
    """Run the command line and exit with its code.

    The exit code is 130 after Ctrl-C and 143 after SIGTERM, whenever these come. No traceback is
    printed.
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
    """Handle a signal: raise KeyboardInterrupt, or end the program while a module is being loaded.

    A signal soon after another one raises nothing: it would stop the making of the answer.
    """
    is_new = program.hear(number)
    if program.is_loading(frame):
        _end()
    if is_new:
        program.raised.append(number)
        raise KeyboardInterrupt


def _end(number: "int | None" = None, _: object = None) -> "NoReturn":
    if number is not None:
        program.heard.append(number)
    os._exit(program.interrupted_code())


if __name__ == "__main__":
    run()
