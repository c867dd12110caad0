"""Reduce a map to what its theory speaks of, before it is listed, counted or compared."""

from __future__ import annotations

from dataclasses import replace

from ssh_abduction.data.maps import SSHMap
from ssh_abduction.theory.theory import Theory


def projected(ssh_map: SSHMap, theory: Theory) -> SSHMap:
    """Return the map without paths if no axiom of the theory says which paths there are."""
    if theory.has_paths or not any(s.path is not None for s in ssh_map.dstates):
        return ssh_map
    dstates = tuple(replace(s, path=None, direction=None) for s in ssh_map.dstates)
    return replace(ssh_map, dstates=dstates, paths=(), excused=())
