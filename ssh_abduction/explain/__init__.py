"""Explain why steps are one dstate, where a place lies, and why a trace has no map."""

from ssh_abduction import lazy_names

TYPE_CHECKING = False

if TYPE_CHECKING:
    from ssh_abduction.explain.mend import explain_trace
    from ssh_abduction.explain.no_map import Explanation, explain, why_apart
    from ssh_abduction.explain.pairs import explain_pair
    from ssh_abduction.explain.sides import PlaceExplanation, explain_place

__all__ = [
    "Explanation",
    "PlaceExplanation",
    "explain",
    "explain_pair",
    "explain_place",
    "explain_trace",
    "why_apart",
]

__getattr__, __dir__ = lazy_names(__name__, __all__)
