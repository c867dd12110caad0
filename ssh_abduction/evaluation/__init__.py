"""Compare maps with the truth, and draw figures."""

from ssh_abduction.runtime.lazy import lazy_names

TYPE_CHECKING = False

if TYPE_CHECKING:
    from ssh_abduction.evaluation.named_truth import Evaluation as Evaluation
    from ssh_abduction.evaluation.named_truth import MapEvaluation as MapEvaluation
    from ssh_abduction.evaluation.named_truth import evaluate as evaluate
    from ssh_abduction.evaluation.named_truth import tells_names as tells_names
    from ssh_abduction.evaluation.pose_truth import MapPairs as MapPairs
    from ssh_abduction.evaluation.pose_truth import VisitsEvaluation as VisitsEvaluation
    from ssh_abduction.evaluation.pose_truth import evaluate_visits as evaluate_visits
    from ssh_abduction.evaluation.pose_truth import told_poses as told_poses
    from ssh_abduction.evaluation.trajectory import Relations as Relations
    from ssh_abduction.evaluation.trajectory import Trajectory as Trajectory

__getattr__, __dir__ = lazy_names(__name__)
