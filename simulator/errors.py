"""Errors of the simulator."""

from ssh_abduction.data.errors import AbductionError


class SimulatorError(AbductionError, ValueError):
    """A world, pose or tour that cannot be simulated.

    The text says what was expected, what came, and how to mend it.
    """


class SimulatorWarning(UserWarning):
    """A drive was simulated but may not be what was meant. The text says why."""
