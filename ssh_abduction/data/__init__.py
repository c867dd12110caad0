"""The values that all other packages share: traces, maps, stars, odometry, files and errors.

A star is what a robot sees of the ways out of a place. Each name is loaded when it is first used,
so that a program loads only what it needs.
"""

from ssh_abduction import lazy_names

TYPE_CHECKING = False

if TYPE_CHECKING:
    from ssh_abduction.data.closure import Closure
    from ssh_abduction.data.corrections import Corrections, Naming, Passage, Said
    from ssh_abduction.data.corrections_file import load_corrections, save_corrections
    from ssh_abduction.data.drives import Drive, drives_of, together
    from ssh_abduction.data.errors import (
        AbductionError,
        LocaliserError,
        MapError,
        RangeError,
        SolverError,
        TheoryError,
        TraceError,
    )
    from ssh_abduction.data.maps import DState, Fault, Fit, MapPath, Name, Pose, SSHMap
    from ssh_abduction.data.odometry import Odometry
    from ssh_abduction.data.regions import Region
    from ssh_abduction.data.star import Star
    from ssh_abduction.data.trace import Action, Step, Trace

__all__ = [
    "AbductionError",
    "Action",
    "Closure",
    "Corrections",
    "DState",
    "Drive",
    "Fault",
    "Fit",
    "LocaliserError",
    "MapError",
    "MapPath",
    "Name",
    "Naming",
    "Odometry",
    "Passage",
    "Pose",
    "RangeError",
    "Region",
    "SSHMap",
    "Said",
    "SolverError",
    "Star",
    "Step",
    "TheoryError",
    "Trace",
    "TraceError",
    "drives_of",
    "load_corrections",
    "save_corrections",
    "together",
]

__getattr__, __dir__ = lazy_names(__name__, __all__)
