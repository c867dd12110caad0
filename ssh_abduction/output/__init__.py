"""Pictures, graphs and exports of maps for other programs."""

from ssh_abduction.output.export import export_map

__all__ = ["export_map"]
