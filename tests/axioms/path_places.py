"""The axiom path_places: a path has at most n places."""

from __future__ import annotations

from brute_force import Key

from ssh_abduction import Theory
from ssh_abduction.data import Trace

# A robot drives round the notched rectangle. With few paths, the fourth side is the first one.
AT_MOST_THREE = Theory.circumscriptive().replace(path_places=3)
CASE = (
    AT_MOST_THREE,
    "v0 R v1 T v2 R v3 T v0 R v1 T v2 R v3 T v0",
    "",
    ((9, 3, 4), 1),
    ((9, 5, 3), 1),
)
BROKEN = (Theory.topological().replace(path_places=1), "a T b", "0 1", "0:0+ 1:0+", "01")


def path_places(trace: Trace, theory: Theory, key: Key) -> bool:
    _, places, courses = key
    along = [(course[0], p) for p, course in zip(places, courses, strict=True) if course]
    if "on_path" not in theory.axioms:
        return True
    most = theory.declared["path_places"]
    return all(len({p for g, p in along if g == h}) <= most for h, _ in along)
