"""Pictures, graphs and exports of maps for other programs."""

from ssh_abduction import lazy_names

TYPE_CHECKING = False

if TYPE_CHECKING:
    from ssh_abduction.output.export import export_map

_HOMES = {
    "export": ("export_map",),
}
__all__ = [
    "export_map",
]

__getattr__, __dir__ = lazy_names(__name__, _HOMES, __all__)
