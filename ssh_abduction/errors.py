"""Every error that a user can cause or mend: one root, one subclass a layer."""

from __future__ import annotations


class SSHError(Exception):
    """Root of the package's errors. Its text is one line: what was expected, what came, how to mend it."""


class TraceError(SSHError):
    """A trace, or a file of one, is malformed."""


class TheoryError(SSHError):
    """The choices of a theory contradict each other, or the trace lacks what they need."""


class MapError(SSHError):
    """A map, or a file of maps, is malformed."""


class SolverError(SSHError):
    """The solver cannot do what was asked."""


def named(source: object) -> str:
    """A file's name as an error message shows it: on one line."""
    text = str(source)
    return text if text.isprintable() else repr(text)


def brief(value: object, width: int = 60) -> str:
    """`value` as an error message shows it: on one line, cut to `width` characters."""
    text = repr(value)
    return text if len(text) <= width else text[: width - 1] + "…"
