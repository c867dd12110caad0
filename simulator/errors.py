"""Errors of the simulator."""

from ssh_abduction.data.errors import AbductionError


class SimulatorError(AbductionError, ValueError):
    """A world, pose or tour that cannot be simulated.

    The text says what was expected, what was found, and how to correct it.
    """


class SimulatorWarning(UserWarning):
    """A simulated drive may differ from the intended one. The text says why."""
