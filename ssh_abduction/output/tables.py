"""Convert a map to a pandas table."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from ssh_abduction.data.errors import MapError
from ssh_abduction.data.maps import SSHMap, checked_map

if TYPE_CHECKING:
    import pandas as pd


def to_pandas(ssh_map: SSHMap) -> pd.DataFrame:
    """Make a table with a row for each step of the trace that was mapped.

    Returns:
        A table with the columns dstate, view, place, path, direction and heading. If the map has
        poses, also x and y (metres) and pose_heading (radians). If it has names, also place_name.
        The index is named step.

    Raises:
        MapError: `ssh_map` is not a map, or pandas is not installed.
    """
    checked_map(ssh_map)
    try:
        import pandas as pd
    except ImportError:
        raise MapError(
            "to_pandas: expected pandas, got none; install it with pip install pandas"
        ) from None
    rows = []
    for s in (ssh_map.dstates[label] for label in ssh_map.dstate_at):
        row: dict[str, Any] = {
            "dstate": s.id,
            "view": s.view,
            "place": s.place,
            "path": s.path,
            "direction": s.direction,
            "heading": s.heading,
            "floor": s.floor,
        }
        if ssh_map.names:
            row["place_name"] = ssh_map.name_of("place", s.place)
        if ssh_map.fit and ssh_map.fit.poses:
            pose = ssh_map.fit.poses[s.id]
            row |= {"x": pose.x, "y": pose.y, "pose_heading": pose.heading}
        rows.append(row)
    table = pd.DataFrame(rows, index=pd.RangeIndex(len(rows), name="step"))
    whole = ["place", "path", "direction", "heading", "floor"]
    return table.astype(dict.fromkeys(whole, "Int64"))  # integers that may be missing
