"""Why two steps are different dstates, why a trace has no map, and what would mend it."""

from ssh_abduction.explain.no_map import Explanation, explain, why_apart
from ssh_abduction.explain.pairs import explain_pair, explain_trace

__all__ = ["Explanation", "explain", "explain_pair", "explain_trace", "why_apart"]
