"""Compare maps with the truth, measure how evidence helps, and repeat the paper's experiments."""

from ssh_abduction import lazy_names

TYPE_CHECKING = False

if TYPE_CHECKING:
    from ssh_abduction.evaluation.named_truth import (
        Evaluation,
        MapEvaluation,
        evaluate,
        tells_names,
    )
    from ssh_abduction.evaluation.pose_truth import (
        JudgedPairs,
        MapPairs,
        MapVisits,
        VisitsEvaluation,
        evaluate_visits,
        told_poses,
    )
    from ssh_abduction.evaluation.relations import Relation, Relations
    from ssh_abduction.evaluation.trajectory import Trajectory, TrajectoryWarning

__all__ = [
    "Evaluation",
    "JudgedPairs",
    "MapEvaluation",
    "MapPairs",
    "MapVisits",
    "Relation",
    "Relations",
    "Trajectory",
    "TrajectoryWarning",
    "VisitsEvaluation",
    "evaluate",
    "evaluate_visits",
    "tells_names",
    "told_poses",
]

__getattr__, __dir__ = lazy_names(__name__, __all__)
