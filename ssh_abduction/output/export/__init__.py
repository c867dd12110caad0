"""Maps for other programs: one module for each format, and the table of formats."""

from __future__ import annotations

from ssh_abduction.output.export.formats import FORMATS, export_map
from ssh_abduction.output.export.roads import Road, Roads, Stop

__all__ = ["FORMATS", "Road", "Roads", "Stop", "export_map"]
