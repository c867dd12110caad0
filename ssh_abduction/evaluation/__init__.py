"""How right maps are. Nothing that infers maps may import this folder: it knows the truth, and infers nothing."""

from ssh_abduction.evaluation.names import Evaluation, MapEvaluation, evaluate, tells_names
from ssh_abduction.evaluation.relations import Relation, Relations
from ssh_abduction.evaluation.trajectory import Trajectory, TrajectoryWarning
from ssh_abduction.evaluation.visits import MapPairs, MapVisits, Pairs, VisitsEvaluation, evaluate_visits, told_poses

__all__ = [
    "Evaluation",
    "MapEvaluation",
    "MapPairs",
    "MapVisits",
    "Pairs",
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
