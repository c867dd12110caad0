"""Write maps in the formats of other programs. `formats` has the main function."""

from __future__ import annotations

from ssh_abduction.output.export.formats import FORMATS, export_map
from ssh_abduction.output.export.roads import Road, Roads, Stop

__all__ = ["FORMATS", "Road", "Roads", "Stop", "export_map"]
