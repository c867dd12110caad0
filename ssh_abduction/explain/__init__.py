"""Explain why steps are one dstate, where a place lies, and why a trace has no map."""

from ssh_abduction.runtime.lazy import lazy_names

TYPE_CHECKING = False

if TYPE_CHECKING:
    from ssh_abduction.explain.no_map import explain_trace as explain_trace
    from ssh_abduction.explain.no_map import why_apart as why_apart
    from ssh_abduction.explain.pair_reasons import explain_pair as explain_pair
    from ssh_abduction.explain.place_reasons import explain_place as explain_place

__getattr__, __dir__ = lazy_names(__name__)
