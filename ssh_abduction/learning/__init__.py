"""Bootstrap learning (Kuipers & Beeson 2002): images, views, map, labels, recogniser."""

from ssh_abduction.runtime.lazy import lazy_names

TYPE_CHECKING = False

if TYPE_CHECKING:
    from ssh_abduction.learning.learner import BootstrapLearner as BootstrapLearner

__getattr__, __dir__ = lazy_names(__name__)
