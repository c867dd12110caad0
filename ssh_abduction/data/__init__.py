"""The values that all other packages share: traces, maps, stars, odometry, files and errors.

A star is what a robot sees of the ways out of a place. Each name is loaded when it is first used,
so that a program loads only what it needs.
"""

from ssh_abduction.runtime.lazy import lazy_names

TYPE_CHECKING = False

if TYPE_CHECKING:
    from ssh_abduction.data.corrections import Corrections as Corrections
    from ssh_abduction.data.corrections import Naming as Naming
    from ssh_abduction.data.corrections import Passage as Passage
    from ssh_abduction.data.corrections import Said as Said
    from ssh_abduction.data.corrections import load_corrections as load_corrections
    from ssh_abduction.data.corrections import save_corrections as save_corrections
    from ssh_abduction.data.drives import Drive as Drive
    from ssh_abduction.data.drives import drives_of as drives_of
    from ssh_abduction.data.drives import together as together
    from ssh_abduction.data.errors import AbductionError as AbductionError
    from ssh_abduction.data.errors import LocaliserError as LocaliserError
    from ssh_abduction.data.errors import MapError as MapError
    from ssh_abduction.data.errors import RangeError as RangeError
    from ssh_abduction.data.errors import SolverError as SolverError
    from ssh_abduction.data.errors import TheoryError as TheoryError
    from ssh_abduction.data.errors import TraceError as TraceError
    from ssh_abduction.data.map_parts import Region as Region
    from ssh_abduction.data.maps import DState as DState
    from ssh_abduction.data.maps import Fault as Fault
    from ssh_abduction.data.maps import Fit as Fit
    from ssh_abduction.data.maps import MapPath as MapPath
    from ssh_abduction.data.maps import Name as Name
    from ssh_abduction.data.maps import Pose as Pose
    from ssh_abduction.data.maps import SSHMap as SSHMap
    from ssh_abduction.data.odometry import Closure as Closure
    from ssh_abduction.data.odometry import Odometry as Odometry
    from ssh_abduction.data.star import Star as Star
    from ssh_abduction.data.trace import Action as Action
    from ssh_abduction.data.trace import Step as Step
    from ssh_abduction.data.trace import Trace as Trace

__getattr__, __dir__ = lazy_names(__name__)
