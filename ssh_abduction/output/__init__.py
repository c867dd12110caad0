"""Functions that turn a map into pictures, graphs, tables, notebook cards and files.

Each function is loaded when it is first used, as some need networkx, scipy, matplotlib or pandas.
"""

from ssh_abduction import lazy_names

TYPE_CHECKING = False

if TYPE_CHECKING:
    from ssh_abduction.output.cards import map_card, trace_card
    from ssh_abduction.output.dot import to_dot
    from ssh_abduction.output.export import export_map
    from ssh_abduction.output.graphs import to_graphml, to_networkx, to_pandas
    from ssh_abduction.output.picture import to_svg
    from ssh_abduction.output.plotting import plot

__all__ = [
    "export_map",
    "map_card",
    "plot",
    "to_dot",
    "to_graphml",
    "to_networkx",
    "to_pandas",
    "to_svg",
    "trace_card",
]

__getattr__, __dir__ = lazy_names(__name__, __all__)
