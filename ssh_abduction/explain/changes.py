"""Say which gateways changed between drives, what that costs, and what a map costs without changes.

A change is a fault of kind "changed": a gateway that was open on one drive and closed on another.
"""

from __future__ import annotations

from collections.abc import Collection

from ssh_abduction.data.maps import Fault, SSHMap
from ssh_abduction.solver import Cost, Search, Status


def changes_at(ssh_map: SSHMap, places: Collection[int | None]) -> tuple[Fault, ...]:
    """Find the changes of gateways at these places of a map."""
    return tuple(f for f in ssh_map.faults if f.kind == "changed" and f.place in places)


def changes_in_words(
    changes: Collection[Fault], cost: Cost, nats: float | None, without: Search
) -> list[str]:
    """Say what changed, and what a map costs without changes.

    Args:
        changes: Some changes of a map.
        cost: The cost of this map.
        nats: Its cost in nats; None if maps are not weighed.
        without: An ended search for the best map without any changes.

    Returns:
        A sentence for each change; and one for the map without changes.
    """
    said = [f"{change}; this change costs {change.cost:g} dstates" for change in changes]
    if without.status is Status.UNSATISFIABLE:
        return [*said, "without changes there is no map"]
    if without.cost is None:
        return [*said, "no map without changes was found in time"]
    best = "the best map" if without.status is Status.OPTIMAL else "the best map found"
    if nats is not None and without.nats is not None:
        more = f"costs {without.nats:.1f} nats, not {nats:.1f}"
    else:
        changed = f"{cost.dstates} and changes for {cost.faults:g}"
        more = f"has {without.cost.dstates} dstates, not {changed}"
    return [*said, f"without changes, {best} {more}"]
