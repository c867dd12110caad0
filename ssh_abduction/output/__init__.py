"""Functions that turn a map into pictures, graphs, tables, notebook cards and files.

Each function is loaded when it is first used, as some need networkx, scipy, matplotlib or pandas.
"""

from ssh_abduction.runtime.lazy import lazy_names

TYPE_CHECKING = False

if TYPE_CHECKING:
    from ssh_abduction.output.cards import map_card as map_card
    from ssh_abduction.output.cards import trace_card as trace_card
    from ssh_abduction.output.drawing import plot as plot
    from ssh_abduction.output.drawing import to_svg as to_svg
    from ssh_abduction.output.export import export_map as export_map
    from ssh_abduction.output.graphs import to_dot as to_dot
    from ssh_abduction.output.graphs import to_graphml as to_graphml
    from ssh_abduction.output.graphs import to_networkx as to_networkx
    from ssh_abduction.output.graphs import to_pandas as to_pandas

__getattr__, __dir__ = lazy_names(__name__)
