"""Check what a file of maps claims (status, counts, costs, bounds) against its maps and its proof.

`check_bound` checks a certificate: a proof that all maps have at least some number of dstates.

>>> from ssh_abduction.checker.claims import false_claims
>>> from ssh_abduction.data.maps import DState, SSHMap
>>> from ssh_abduction.theory.theory import Theory
>>> one = SSHMap((0,), (DState(0, "a"),), ())
>>> answer = {"status": "optimal", "count": 2, "bound": {"dstates": 1}}
>>> false_claims(answer, [one], 1, Theory.causal(), 1)
('count: expected 1, the number of maps listed, got 2',)
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, groupby
from typing import Any

from ssh_abduction.data.checks import an_object
from ssh_abduction.data.errors import MapError, brief, is_finite, is_whole
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Step, Trace
from ssh_abduction.data.words import counted
from ssh_abduction.theory.fields import COUNTS
from ssh_abduction.theory.theory import Theory

STATUSES = ("optimal", "feasible", "unsatisfiable", "unknown")
# Why a search may have been stopped.
REASONS = ("work limit", "time limit", "memory limit", "interrupted", "maps limit", "no proof")


def false_claims(
    answer: Mapping[str, Any],
    maps: Sequence[SSHMap],
    steps: int,
    theory: Theory,
    proven: int | None,
) -> tuple[str, ...]:
    """Find the false claims in the JSON that `solve --json` printed. Each claim is checked.

    `steps` is the number of steps of the trace. In the theory no field is "auto". `proven` is the
    lower bound on dstates by the certificate of the answer. The certificate may also say that
    clingo refuted some numbers of dstates. These count in the bound, but are not checked. If
    `proven` is None, the certificate is not checked, because that needs the trace, nor are costs
    and bounds if the theory allows faults.
    """
    is_priced = proven is not None or not theory.has_faults
    claims = _Claims(answer, maps, steps, theory, sys.maxsize if proven is None else proven)
    checks = [claims.sizes, claims.twice, claims.status]
    checks += [claims.cost, claims.bound] if is_priced else []
    return tuple(false for check in checks for false in check())


class _Claims:
    """The claims of an answer. Each method yields a sentence for each false claim."""

    def __init__(
        self,
        answer: Mapping[str, Any],
        maps: Sequence[SSHMap],
        steps: int,
        theory: Theory,
        proven: int,
    ) -> None:
        self.answer, self.maps, self.steps = answer, maps, steps
        self.theory, self.proven = theory, proven
        self.counts = [_counts(ssh_map) for ssh_map in maps]
        self.first = next(iter(theory.priorities), None)
        # If axioms are left out, clingo may count more than the maps show.
        self.is_exact = not theory.without
        # Whether the bound has to be the cost of map 1.
        is_optimal = answer.get("status") == "optimal" and "bound" in answer and bool(maps)
        self.is_tight = is_optimal and self.is_exact and theory.weigh != "cost"

    def sizes(self) -> Iterator[str]:
        """Check the claimed numbers of steps and maps, and the range of `prefix`."""
        for name, number, what in (
            ("count", len(self.maps), "maps listed"),
            ("steps", self.steps, "steps of the trace"),
        ):
            got = self.answer.get(name, number)
            if not is_whole(got) or got != number:
                yield f"{name}: expected {number}, the number of {what}, got {brief(got)}"
        prefix = self.answer.get("prefix", 0)
        if not is_whole(prefix) or not 0 <= prefix <= self.steps:
            yield (
                f"prefix: expected 0 to {self.steps}, the number of steps of the trace, got "
                f"{brief(prefix)}"
            )

    def twice(self) -> Iterator[str]:
        """Check that each map is listed once, up to renaming."""
        seen: dict[SSHMap, int] = {}
        for i, ssh_map in enumerate(self.maps):
            first = seen.setdefault(ssh_map.renumbered(), i)
            if first < i:
                yield (
                    f"maps: expected each map once, got maps {first + 1} and {i + 1}, which are "
                    "the same up to renaming"
                )

    def status(self) -> Iterator[str]:
        """Check that `status`, `complete` and `stopped` agree with each other and with the maps."""
        status, complete, stopped = (
            self.answer.get(name) for name in ("status", "complete", "stopped")
        )
        if "status" in self.answer:
            if status not in STATUSES:
                yield f"status: expected one of {', '.join(STATUSES)}, got {brief(status)}"
            elif bool(self.maps) != (status in ("optimal", "feasible")):
                expected = (
                    "optimal or feasible, as there is a map"
                    if self.maps
                    else "unsatisfiable or unknown, as there is no map"
                )
                yield f"status: expected {expected}, got {status}"
            elif status == "feasible" and len(self.maps) > 1:
                yield f"maps: expected one, as the status is feasible, got {len(self.maps)}"
        if stopped is not None and stopped not in REASONS:
            yield f"stopped: expected one of {', '.join(REASONS)}, got {brief(stopped)}"
        if "complete" not in self.answer:
            return
        if not isinstance(complete, bool):
            yield f"complete: expected true or false, got {brief(complete)}"
        elif complete and status in ("feasible", "unknown"):
            yield f"complete: expected false, as the status is {status}, got true"
        elif complete and self.maps and stopped is not None:
            yield (
                f"complete: expected false, as the search was stopped ({brief(stopped)}), got true"
            )
        elif not complete and status == "unsatisfiable":
            yield "complete: expected true, as the status is unsatisfiable, got false"

    def cost(self) -> Iterator[str]:
        """Check that the first map has the claimed cost and that all maps are equally good.

        If the answer also lists maps above the minimum, `_costs_within` checks their costs.
        """
        if "cost" in self.answer:
            cost = self.answer["cost"]
            expected = _shown(self._least(cost)) if self.maps else None
            whole = isinstance(cost, Mapping) and all(
                is_whole(value) for name, value in cost.items() if name != "faults"
            )
            if cost != expected or (expected is not None and not whole):
                because = "as map 1 has these" if self.maps else "as there is no map"
                yield f"cost: expected {_text(expected)}, {because}, got {_text(cost)}"
        if not self.is_exact:
            return
        is_counted = self.theory.weigh != "cost"
        if "within" in self.answer:
            yield from self._costs_within() if is_counted else self._costs_of_each()
            return
        best = self._preferred(0)
        # Maps of one cost in nats may have different counts (checker/cost_claims.py).
        for i in range(len(self.counts) if is_counted else 0):
            if (here := self._preferred(i)) != best:
                preferred = ", ".join(self.theory.priorities)
                yield (
                    f"maps: expected equal numbers of {preferred}, as minimal maps have, got "
                    f"{best} in map 1 and {here} in map {i + 1}"
                )

    def _preferred(self, i: int) -> list[float]:
        """List the counts of map i that the theory minimises, the most important first.

        Empty if there is no map i.
        """
        return [
            counts[name] for counts in self.counts[i : i + 1] for name in self.theory.priorities
        ]

    def _costs_within(self) -> Iterator[str]:
        """Check the maps of an answer that also lists maps above the minimum.

        The level of a map is its number of dstates, or of the first other count that the theory
        minimises, except excuses. The maps must be sorted by level. No level may exceed the minimum
        by more than `within`. Maps of one level must be equally good. Each map and each level must
        have the claimed cost.
        """
        within = self.answer["within"]
        sort = next((name for name in self.theory.priorities if name != "excuses"), None)
        if not is_whole(within) or within < 0:
            yield f"within: expected a whole number, 0 or more, got {brief(within)}"
            return
        for i, counts in enumerate(self.counts):
            last = self.counts[max(i - 1, 0)]
            most = self.counts[0][sort] + within if sort else 0
            best, here = self._preferred(max(i - 1, 0)), self._preferred(i)
            # maps are sorted by level, and maps of one level are equally good
            if sort and not last[sort] <= counts[sort] <= most:
                yield (
                    f"maps: expected {last[sort]} to {most} {sort} in map {i + 1}, as within "
                    f"is {within}, got {counts[sort]}"
                )
            elif (not sort or last[sort] == counts[sort]) and best != here:
                preferred = ", ".join(self.theory.priorities)
                yield (
                    f"maps: expected equal numbers of {preferred} in maps {i} and {i + 1}, which "
                    f"are of one level, got {best} and {here}"
                )
        yield from self._costs_of_each()
        levels = []
        for _, level in groupby(range(len(self.counts)), key=self._preferred):
            first, *others = level
            levels.append({"cost": _shown(self.counts[first]), "count": 1 + len(others)})
        if "levels" in self.answer and self.answer["levels"] != levels:
            yield (
                f"levels: expected {brief(levels)}, as the maps have these, got "
                f"{brief(self.answer['levels'])}"
            )

    def _costs_of_each(self) -> Iterator[str]:
        """Check that each map has the cost that is claimed for it."""
        listed = self.answer.get("maps")
        shown = map(_shown, self.counts)
        for i, (said, counts) in enumerate(
            zip(listed if isinstance(listed, Sequence) else (), shown, strict=False)
        ):
            if isinstance(said, Mapping) and said.get("cost", counts) != counts:
                yield (
                    f"maps[{i}].cost: expected {_text(counts)}, as the map has these, got "
                    f"{_text(said['cost'])}"
                )

    def _least(self, cost: Any) -> dict[str, float]:
        """Return the counts that `cost` should have, as a dict from name to number.

        These are the counts of the first map. If axioms are left out, clingo may count more than
        the map lists. Then a larger number in `cost` is right, too.
        """
        shown = self.counts[0]
        if self.is_exact or not isinstance(cost, Mapping):
            return shown
        more = {
            k: cost[k]
            for k in self.theory.priorities
            if is_whole(cost.get(k)) and cost[k] >= shown[k]
        }
        return shown | more

    def bound(self) -> Iterator[str]:
        """Check the claimed lower bounds.

        No map may be below a bound. The certificate must prove the bound on dstates. If the status
        is optimal, the bound must equal the cost.
        """
        if self.theory.has_faults:
            yield from self._bound_with_faults()
            return
        bound = self.answer.get("bound", {})
        if not isinstance(bound, Mapping) or not all(
            name in COUNTS and is_whole(value) and value >= 0 for name, value in bound.items()
        ):
            yield f"bound: expected numbers of {', '.join(COUNTS)}, got {brief(bound)}"
            return
        for name, value in bound.items():
            if name not in ("dstates", self.first):
                preferred = (
                    f"the theory minimises {self.first} first"
                    if self.first
                    else "the theory prefers nothing"
                )
                yield f"bound: expected none of {name}, as {preferred}, got {value}"
            below = [i for i, counts in enumerate(self.counts) if counts[name] < value]
            if below and self.is_exact:
                yield (
                    f"bound: expected at most {self.counts[below[0]][name]} {name}, as map "
                    f"{below[0] + 1} has no more, got {value}"
                )
        if bound.get("dstates", 0) > self.proven:
            yield (
                f"bound: expected at most {self.proven} dstates, as the certificate proves no "
                f"more, got {bound['dstates']}"
            )
        least = self.counts[0][self.first] if self.is_tight and self.first else 0
        if self.first and bound.get(self.first, 0) < least:
            yield (
                f"bound: expected {least} {self.first}, the cost of map 1, as the status is "
                f"optimal, got {bound.get(self.first, 'none')}"
            )

    def _bound_with_faults(self) -> Iterator[str]:
        """Check the claimed lower bound on the cost of dstates and faults together, in dstates."""
        bound = self.answer.get("bound", {})
        cost = bound.get("cost", 0) if isinstance(bound, Mapping) else None
        if not (is_finite(cost) and cost >= 0 and set(bound) <= {"cost"}):
            yield f"bound: expected a cost in dstates, got {brief(bound)}"
            return
        costs = [counts["tenths"] / 10 for counts in self.counts]
        below = [i for i, least in enumerate(costs) if least < cost]
        if below and self.is_exact:
            i = below[0]
            yield (
                f"bound.cost: expected at most {costs[i]:g} dstates, as map {i + 1} costs no more, "
                f"got {cost:g}"
            )
        elif self.is_tight and cost < costs[0]:
            yield (
                f"bound.cost: expected {costs[0]:g} dstates, the cost of map 1, as the status is "
                f"optimal, got {cost:g}"
            )


def _counts(ssh_map: SSHMap) -> dict[str, float]:
    """Count the dstates, places, paths and excuses of a map, and what its faults cost in dstates.

    "tenths" is the cost of dstates and faults together, in tenths of a dstate.
    """
    dstates, faults = len(ssh_map.dstates), sum(round(10 * one.cost) for one in ssh_map.faults)
    return {
        "dstates": dstates,
        "places": len(ssh_map.places),
        "paths": len(ssh_map.theory_paths),
        "excuses": len(ssh_map.excused),
        "faults": faults / 10,
        "tenths": 10 * dstates + faults,
    }


def _shown(counts: Mapping[str, float]) -> dict[str, float]:
    """Return counts as an answer writes them: without excuses and faults if there are none."""
    return {
        k: v
        for k, v in counts.items()
        if k in ("dstates", "places", "paths") or (v and k != "tenths")
    }


def _text(counts: Any) -> str:
    """Put claimed counts into words."""
    return (
        ", ".join(counted(value, name) for name, value in counts.items())
        if isinstance(counts, Mapping) and counts
        else brief(counts)
    )


@dataclass(frozen=True, slots=True)
class ProvenBound:
    """The lower bound that a certificate proves, and what is wrong with the certificate.

    Attributes:
        dstates: A lower bound on the dstates of every map: the size of the clique. It is proven
            only if `faults` is empty.
        refuted: Further numbers of dstates, from `dstates` up, for which the certificate says that
            clingo found no map. This is not checked here.
        faults: A sentence for each pair of steps that the certificate does not show to be distinct.
    """

    dstates: int
    refuted: tuple[int, ...]
    faults: tuple[str, ...]


def check_bound(trace: Trace, certificate: Any) -> ProvenBound:
    """Return the lower bound on dstates that a certificate proves, and the certificate's faults.

    A certificate has a clique: steps that are pairwise at different dstates. Two steps are at
    different dstates if the same actions lead from them to different views, because a dstate has
    one view and actions are deterministic. So for each pair of the clique, the check follows the
    actions that the trace has after both steps, and compares the views at the end. Raises MapError
    if the certificate is malformed.
    """
    an_object("certificate", certificate, MapError, mend="write it with solve --json")
    if "clique" not in certificate:
        raise MapError(
            "certificate: clique: expected a clique, got none; write the file with solve --json"
        )
    steps, refuted = (certificate.get(name, []) for name in ("clique", "refuted"))
    if (
        not _integers(steps)
        or not all(0 <= step < len(trace) for step in steps)
        or len(set(steps)) < len(steps)
    ):
        raise MapError(
            f"certificate: clique: expected different steps, 0 to {len(trace) - 1}, got "
            f"{brief(steps)}; write it with solve --json"
        )
    if not _integers(refuted) or refuted != list(range(len(steps), len(steps) + len(refuted))):
        raise MapError(
            f"certificate: refuted: expected the numbers from {len(steps)} up without a gap, got "
            f"{brief(refuted)}; write it with solve --json"
        )
    faults = [fault for pair in combinations(steps, 2) if (fault := _not_apart(trace, *pair))]
    return ProvenBound(len(steps), tuple(refuted), tuple(faults))


def _integers(values: Any) -> bool:
    """Tell whether a value is a list of whole numbers."""
    return isinstance(values, list) and all(
        isinstance(value, int) and not isinstance(value, bool) for value in values
    )


def _look_different(here: Step, there: Step) -> bool:
    """Tell whether the views of two steps are known and different."""
    return None not in (here.view, there.view) and here.view != there.view


def _common_actions(trace: Trace, i: int, j: int) -> list[str]:
    """List the actions done after both steps, until the views or actions differ."""
    word: list[str] = []
    for here, there in zip(trace.steps[i:], trace.steps[j:], strict=False):
        if (
            _look_different(here, there)
            or here.action is None
            or there.action is None
            or here.action.name != there.action.name
        ):
            break
        word.append(here.action.name)
    return word[: len(trace) - 1 - max(i, j)]


def _not_apart(trace: Trace, i: int, j: int) -> str | None:
    """Say why the trace does not show that two steps are at different dstates; None if it does."""
    word = _common_actions(trace, i, j)
    if not _look_different(trace.steps[i + len(word)], trace.steps[j + len(word)]):
        led = (
            "the same view"
            if trace.steps[i + len(word)].view == trace.steps[j + len(word)].view
            else "a view that is unknown"
        )
        return f"steps {i} and {j}: {' '.join(word) or 'nothing done'} leads to {led} from both"
    return None
