"""Compare rivals (minimal maps of one trace), and find an experiment that distinguishes them."""

from ssh_abduction import lazy_names

TYPE_CHECKING = False

if TYPE_CHECKING:
    from ssh_abduction.rivals.comparison import Comparison, compare
    from ssh_abduction.rivals.differences import Difference, difference
    from ssh_abduction.rivals.drive_joins import DrivePair, joins_of_drives
    from ssh_abduction.rivals.experiment import Experiment
    from ssh_abduction.rivals.explore import next_experiment
    from ssh_abduction.rivals.listing import Listing
    from ssh_abduction.rivals.sides import SharedSides, shared_sides

__all__ = [
    "Comparison",
    "Difference",
    "DrivePair",
    "Experiment",
    "Listing",
    "SharedSides",
    "compare",
    "difference",
    "joins_of_drives",
    "next_experiment",
    "shared_sides",
]

__getattr__, __dir__ = lazy_names(__name__, __all__)
