"""Make the map in which steps share a dstate only if the axioms force them to.

>>> from ssh_abduction import Theory, Trace
>>> from ssh_abduction.solver.guesses.separate import separate_map
>>> from ssh_abduction.theory.settle import settle
>>> trace = Trace.from_steps("abacd", ["around", "around", "around", "travel"])
>>> theory = settle(trace, Theory(star="none")).theory
>>> separate_map(trace, theory) is None  # the travel puts steps 1 and 3 on one path
True
>>> separate_map(trace.prefix(4), theory).dstate_at
(0, 1, 2, 3)

Two axioms force steps to share a dstate if places have no frames. By `deterministic`, the same
action leads from one dstate to one dstate. By `one_dstate_per_course`, a place has one dstate for
each direction of a path. A path may become known late: if a robot turns around several times, and
then travels, all these turns are on the path of the travel.

All travels lead to new places unless they repeat a link. So the places and paths make a tree, as in
`guesses/sketch.py`, and the axioms of order and sides hold. The claim needs axioms that are
universal and places without frames. The caller checks the map in any case.
"""

from __future__ import annotations

from collections.abc import Sequence

from ssh_abduction.data.groups import NodeClasses, numbered
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Trace
from ssh_abduction.runtime.clock import look_at_clock
from ssh_abduction.solver.guesses.completing import completed
from ssh_abduction.solver.steps.log import observation
from ssh_abduction.theory.theory import Theory


def has_no_frames(theory: Theory) -> bool:
    """Whether maps have places, but these have no frames of numbered directions."""
    return theory.level == "topological" and theory.star not in ("frame", "gateways")


def separate_map(trace: Trace, theory: Theory) -> SSHMap | None:
    """Make a map in which steps share a dstate only if the axioms force them to.

    The caller has to check the map. Returns None if two steps that must share a dstate look
    different, or if a path would be a circle.
    """
    same = NodeClasses[int]()
    for i, j in theory.same:
        same.merge(i, j)
    while True:
        look_at_clock()
        _follow(same, trace)
        labels = numbered(map(same.of, range(len(trace))))
        if not _look_alike(labels, trace, theory):
            return None
        ssh_map = completed(trace, theory, labels, _places(labels, trace, theory), ())
        if ssh_map is None or not _join_courses(same, ssh_map):
            return ssh_map


def _follow(same: NodeClasses[int], trace: Trace) -> None:
    """Join steps to which the same action leads from one dstate."""
    grows = True
    while grows:
        grows, links = False, dict[tuple[int, str], int]()
        for t, action in enumerate(trace.actions):
            if not action.starts:
                there = links.setdefault((same.of(t), action.name), t + 1)
                grows = _joined(same, there, t + 1) or grows


def _join_courses(same: NodeClasses[int], ssh_map: SSHMap) -> bool:
    """Join steps at one place that are along one path in one direction. Return whether any were."""
    grows, along = False, dict[tuple[int | None, int, int | None], int]()
    for t, label in enumerate(ssh_map.dstate_at):
        s = ssh_map.dstates[label]
        if s.path is not None:
            first = along.setdefault((s.place, s.path, s.direction), t)
            grows = _joined(same, first, t) or grows
    return grows


def _joined(same: NodeClasses[int], i: int, j: int) -> bool:
    """Join two steps. Return whether they were apart."""
    were_apart = not same.are_one(i, j)
    same.merge(i, j)
    return were_apart


def _places(labels: Sequence[int], trace: Trace, theory: Theory) -> list[int]:
    """Number the place of each dstate: turns stay at their place, and so do asserted steps."""
    place = NodeClasses[int]()
    for i, j in theory.same_place:
        place.merge(labels[i], labels[j])
    for here, action, there in zip(labels, trace.actions, labels[1:], strict=False):
        if action.turn is not None and not action.unlinked:
            place.merge(here, there)
    return numbered(map(place.of, range(max(labels) + 1)))


def _look_alike(labels: Sequence[int], trace: Trace, theory: Theory) -> bool:
    """Whether the steps of each dstate have one view and star. An unknown view may be any view."""
    seen: dict[tuple[int, int], object] = {}
    return all(
        value is None or seen.setdefault((label, kind), value) == value
        for label, step in zip(labels, trace.steps, strict=True)
        for kind, value in enumerate(observation(step, theory))
    )
