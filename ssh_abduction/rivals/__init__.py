"""Compare rivals (minimal maps of one trace), and find an experiment that distinguishes them."""

from ssh_abduction.runtime.lazy import lazy_names

TYPE_CHECKING = False

if TYPE_CHECKING:
    from ssh_abduction.rivals.comparison import Comparison as Comparison
    from ssh_abduction.rivals.comparison import compare as compare
    from ssh_abduction.rivals.differences import Difference as Difference
    from ssh_abduction.rivals.differences import difference as difference
    from ssh_abduction.rivals.differences import shared_sides as shared_sides
    from ssh_abduction.rivals.explore import Experiment as Experiment
    from ssh_abduction.rivals.explore import next_experiment as next_experiment
    from ssh_abduction.rivals.listing import Listing as Listing
    from ssh_abduction.rivals.listing import joins_of_drives as joins_of_drives

__getattr__, __dir__ = lazy_names(__name__)
