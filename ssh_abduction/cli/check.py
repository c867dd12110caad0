"""ssh-abduction check MAPS TRACE: check that maps satisfy the axioms."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from ssh_abduction.checker.checker import Violation, check, unchecked
from ssh_abduction.checker.claims import ProvenBound, check_bound, false_claims
from ssh_abduction.cli.obeyed_corrections import as_corrected
from ssh_abduction.cli.options import (
    add_maps,
    add_theory,
    add_trace,
    solved_trace,
    some_maps,
    theory_of,
    written_theory,
)
from ssh_abduction.cli.outcome import warn
from ssh_abduction.cli.parsing import Verbs
from ssh_abduction.cli.text import counted
from ssh_abduction.data.drives import fingerprints_of
from ssh_abduction.data.errors import MapError, brief, is_finite, named, printable
from ssh_abduction.data.files import json_line
from ssh_abduction.data.map_file import read_json
from ssh_abduction.data.maps import SSHMap, maps_of
from ssh_abduction.data.trace import Trace
from ssh_abduction.explain.no_map import steps_listed
from ssh_abduction.solver import RESTS_ON, Ranking, Sharing, Solution, summary_of
from ssh_abduction.theory.fields import AUTO
from ssh_abduction.theory.settle import settle
from ssh_abduction.theory.theory import Theory

EXIT_VIOLATED = 20
ROUNDED = 1e-4  # a claimed probability may be wrong by this much, as costs in files are rounded
SHOWN = 20  # violations that are printed for each map


@dataclass(frozen=True)
class _Judgement:
    """What `check` found."""

    violations: Sequence[Sequence[Violation]]  # the violations of each map
    theory: Theory  # the theory, in which no field is "auto"
    # Sentences about everything else that was checked, such as bounds and costs.
    said: Sequence[str]
    holds: bool  # whether all maps and claims hold

    @property
    def not_checked(self) -> list[str]:
        """The names of the user's own axioms, which cannot be checked."""
        return list(unchecked(self.theory))

    @property
    def checked(self) -> int:
        """The number of axioms that were checked."""
        return len(set(self.theory.axioms) - set(self.not_checked))

    def to_dict(self) -> dict[str, Any]:
        """Return the fields of the JSON."""
        return {
            "holds": self.holds,
            "maps": len(self.violations),
            "axioms": self.checked,
            "violations": [
                {"map": i, "axiom": v.axiom, "steps": list(v.steps), "message": v.message}
                for i, some in enumerate(self.violations, 1)
                for v in some
            ],
            "not_checked": self.not_checked,
            "sentences": list(self.said),
        }

    def lines(self) -> Iterator[str]:
        """Yield the lines to print."""
        for i, some in enumerate(self.violations, 1):
            for v in some[:SHOWN]:
                steps = f"{steps_listed(v.steps)}: " if v.steps else ""
                yield f"map {i}: {v.axiom}: {steps}{printable(v.message)}"
            if more := some[SHOWN:]:
                yield f"map {i}: and {counted(len(more), 'more violations')}"
        sound = sum(not some for some in self.violations)
        maps = counted(len(self.violations), "maps")
        satisfy = "satisfies" if 1 in (sound, len(self.violations)) else "satisfy"
        yield f"{sound} of {maps} {satisfy} the {self.checked} axioms"
        if self.not_checked:
            names = printable(", ".join(self.not_checked))
            yield f"not checked, as they come from a user's own rules: {names}"
        yield from self.said


def add_parser(verbs: Verbs) -> None:
    parser = verbs.add(
        "check",
        run,
        "judge maps by the axioms",
        "Check maps against a trace and the axioms, without clingo. Reports each axiom that a "
        "map breaks, and at which steps.",
        "Without --theory, the theory in the file of maps is used. The other options change "
        "single fields of it. Corrections in corrections.yaml beside the maps are obeyed. "
        "docs/reference/formats.md describes the JSON.",
    )
    add_maps(parser)
    add_trace(parser)
    parser.add(
        "--bound",
        "also check the other claims of the file: the proof that no map has fewer dstates, the "
        "fits of maps, and what all maps share",
    )
    parser.add("--json", "print the answer as JSON")
    add_theory(parser, default="the theory of the maps, or topological")


def run(options: argparse.Namespace) -> int:
    trace = solved_trace(options)
    data = read_json(options.maps)
    if not _may_be_of(data, trace):
        steps = f"those of {named(trace.source or 'the trace')}"
        warn([f"{named(options.maps)} was made of other steps than {steps}"])
    solved = written_theory(data)
    asked = theory_of(options, solved)
    trace, theory = as_corrected(trace, asked, options.maps)
    theory.check_steps(trace)
    if options.bound:
        maps = maps_of(data, str(options.maps))
    else:
        maps = some_maps(data, options.maps, "check", ", or check its bound (--bound)")
    # Replace each "auto" once for all maps, because counting returns takes long.
    resolved = settle(trace, theory).theory
    made_by = settle(trace, solved or theory).theory
    other = _axioms_of(resolved) != _axioms_of(made_by)
    why = "the file is of another theory"
    if _axioms_of(settle(trace, asked).theory) == _axioms_of(made_by):
        why = "the maps are older than the corrections, so solve again"
    # The regions of a map follow from the theory that made it.
    unjudged = other and any(ssh_map.regions is not None for ssh_map in maps)
    maps = [replace(ssh_map, regions=None) for ssh_map in maps] if unjudged else maps
    violations = [check(trace, ssh_map, resolved) for ssh_map in maps]
    said: list[str] = []  # sentences about what is checked besides the axioms
    if unjudged:
        said.append(f"regions are not checked: {why}")
    holds = not any(violations)
    weighed = data.get("weighed") if isinstance(data, dict) and resolved.weigh == "cost" else None
    if weighed:
        holds &= _costs_hold(trace, data, maps, resolved, str(options.maps), said)
    if options.bound:
        unproven = _why_no_proof(data, resolved, solved)
        broken, doubt = not holds, why if other else None
        if broken:
            doubt = "some maps break axioms" if any(violations) else "a claim about costs is false"
        elif solved is None:
            doubt = "the file names no theory"
        holds &= _bound(trace, data, maps, doubt, made_by, broken, said, unproven)
        if weighed and not unproven:
            said.append(f"that no map costs less than {weighed['bound']:.1f} nats is not checked")
    found = _Judgement(violations, resolved, [*map(printable, said)], holds)
    print(json_line(found.to_dict()) if options.json else "\n".join(found.lines()))
    return 0 if holds else EXIT_VIOLATED


def _may_be_of(data: Any, trace: Trace) -> bool:
    """Whether a file of maps may be of this trace: their drives have the same fingerprints."""
    drives = data.get("drives") if isinstance(data, dict) else None
    drives = drives if isinstance(drives, list) else []
    known = {str(drive.get("fingerprint")) for drive in drives if isinstance(drive, dict)}
    return not known or "None" in known or known == set(fingerprints_of(trace).values())


def _why_no_proof(data: Any, resolved: Theory, solved: Theory | None) -> str | None:
    """Say why a clique of steps proves no bound for these theories; None if it may prove one.

    Raises MapError if the file is no answer of `solve`, or lacks the clique that it should have.
    """
    if not isinstance(data, dict) or "status" not in data:
        raise MapError(
            "bound: expected what solve printed, got only maps; leave out --bound, or take a "
            "file that solve -o wrote"
        )
    if resolved.has_faults or (solved is not None and solved.has_faults):
        return "a map may treat steps as wrong, so steps that look different may be one dstate"
    if resolved.unknown_views:
        return "a step whose view is unknown may be any dstate"
    if RESTS_ON - set(resolved.axioms):
        return "its proof rests on axioms that are left out: functional_view or deterministic"
    if "onto" in data:
        return "this holds for maps that keep the existing map, and solve --onto writes no proof"
    if "certificate" not in data:
        raise MapError(
            "certificate: expected one in the file of maps, got none; leave out --bound, or solve "
            "again"
        )
    return None


def _axioms_of(theory: Theory) -> Theory:
    """Return a theory with the default objective, to compare theories by their axioms alone."""
    return theory.replace(prefer=AUTO, weigh="count")


def _costs_hold(
    trace: Trace,
    data: Mapping[str, Any],
    maps: Sequence[SSHMap],
    theory: Theory,
    where: str,
    said: list[str],
) -> bool:
    """Recompute the costs of maps in nats. Append the result to `said`; return if all hold."""
    # This loads numpy.
    from ssh_abduction.checker.cost_claims import LONGEST, count_checked_rivals, false_costs

    weighed = Solution.from_dict(data, where, trace).weighed  # the fields have the right form
    false = list(false_costs(trace, data, maps, theory))
    for name in ("confidence", "place_confidence") if weighed else ():
        right: float | None = getattr(weighed, name)
        claimed = data["weighed"].get(name)
        if right is None:
            is_right, expected = claimed is None, "null, as the search did not finish"
        else:
            is_right = is_finite(claimed) and abs(claimed - right) <= ROUNDED
            expected = f"{right:.6f}, by the costs of the rivals"
        if not is_right:
            false.append(f"weighed.{name}: expected {expected}, got {brief(claimed)}")
    said += false
    rivals = len(data["weighed"]["rivals"])  # the first one is map 1
    checked = max(count_checked_rivals(len(trace), rivals, theory), 1)
    if len(trace) > LONGEST:
        said.append(f"costs in nats are not checked, as the trace has more than {LONGEST} steps")
        return not false
    if not false:
        others = f" and {counted(checked - 1, 'rivals')}" * (checked > 1)
        said.append(f"the costs in nats of map 1{others} are right: they were computed anew")
    if rivals > checked:
        why = "as paths have a price" if theory.prices[2] else "as that would take long"
        more = counted(rivals - checked, "more rivals")
        said.append(f"the costs of {more} are not checked, {why}")
    return not false


def _bound(
    trace: Trace,
    data: Mapping[str, Any],
    maps: Sequence[SSHMap],
    doubt: str | None,
    solved: Theory,
    broken: bool,
    said: list[str],
    unproven: str | None,
) -> bool:
    """Check the lower bound and the other claims in a file of maps, and append to `said`.

    `doubt` says why clingo's proofs may not hold for this trace and theory, `unproven` why the file
    has no proof of the bound. Returns whether all claims hold.
    """
    bound = None if unproven else check_bound(trace, data["certificate"])
    said += [f"bound: {fault}" for fault in bound.faults] if bound else []
    proven = bound.dstates + len(bound.refuted) if bound else sys.maxsize
    false = [
        *false_claims(data, maps, len(trace), solved, proven),
        *_false_of_maps(data, maps, trace),
    ]
    if not false and not broken and "theory" in data:
        false += _false_of_all(data, trace)
    said += false
    if bound is None:
        said += [] if false else ["the other claims of the file agree with its maps"]
        said.append(f"that no better map exists is not checked: {unproven}")
        return not false
    if bound.faults:
        return False
    fewest = min((len(m.dstates) for m in maps), default=None)
    total = bound.dstates + (0 if doubt else len(bound.refuted))
    said += _bound_in_words(bound, total, fewest, doubt)
    return not false and (fewest is None or fewest >= total)


def _bound_in_words(
    bound: ProvenBound, total: int, fewest: int | None, doubt: str | None
) -> Iterator[str]:
    """Yield sentences about a lower bound of `total` dstates. A map has `fewest`, if there is one.

    `doubt` is as for `_bound`.
    """
    pairs = counted(bound.dstates * (bound.dstates - 1) // 2, "pairs")
    states, steps = counted(bound.dstates, "dstates"), counted(bound.dstates, "steps")
    yield f"at least {states}: no two of {steps} can be one dstate ({pairs} checked)"
    if bound.refuted and doubt:
        refuted = counted(bound.refuted[0], "dstates")
        yield f"clingo's verdict on {refuted} and more is left out: {doubt}"
    elif bound.refuted:
        sizes = str(bound.refuted[0]) + f" to {total - 1}" * (len(bound.refuted) > 1)
        least = counted(total, "dstates")
        yield f"at least {least}, if clingo is right that no map has {sizes}"
    if fewest is not None and fewest < total:
        yield f"the maps have {fewest}, fewer than that, so this bound or a map is wrong"
    elif fewest is not None:
        more = f", {fewest - total} more than proven" if fewest > total else ": no map has fewer"
        yield f"the maps have {fewest}{more}"


def _false_of_maps(data: Mapping[str, Any], maps: Sequence[SSHMap], trace: Trace) -> Iterator[str]:
    """Yield a sentence for each false claim of the file about one map: its id, fit and poses."""
    ranking = Ranking(trace)
    for i, (said, ssh_map) in enumerate(zip(data.get("maps", ()), maps, strict=False)):
        if "id" in said and said["id"] != ssh_map.id:
            digest = f"{ssh_map.id}, the digest of the map"
            yield f"maps[{i}].id: expected {digest}, got {brief(said['id'])}"
        if ssh_map.fit is None and not {"fit", "poses", "spreads"} & set(said):
            continue
        if not trace.has_displacements:
            none = "none, as the trace has no displacements"
            yield f"maps[{i}].fit: expected {none}, got {brief(said.get('fit'))}"
            continue
        right = ranking.fitted(ssh_map).to_dict()
        for name in ("fit", "poses", "spreads"):
            if not _is_near(said.get(name), right[name]):
                expected = f"{brief(right[name])}, by the displacements of the trace"
                yield f"maps[{i}].{name}: expected {expected}, got {brief(said.get(name))}"


def _false_of_all(data: Mapping[str, Any], trace: Trace) -> Iterator[str]:
    """Yield a sentence for each false claim of the file about what all maps share."""
    try:
        solution = Solution.from_dict(data, "the file", trace)
    except MapError as error:
        yield str(error)
        return
    backbone = solution.backbone
    if backbone and backbone.proven and solution.minimal_listed:
        right = Sharing(solution.minimal_maps or solution.maps).backbone(proven=True)
        if backbone.to_dict() != right.to_dict():
            expected = f"{right.sentence or 'the one map'}, as the maps show"
            yield f"backbone: expected {expected}, got {backbone.sentence or 'something else'}"
        backbone = right
    summary = summary_of(solution, solution.count, backbone)
    if data.get("summary", summary) != summary:
        yield f"summary: expected {brief(summary)}, as the maps show, got {brief(data['summary'])}"


def _is_near(said: Any, right: Any) -> bool:
    """Whether all numbers in two nested values are almost equal. Machines round differently."""
    if isinstance(right, Mapping):
        return (
            isinstance(said, Mapping)
            and set(said) == set(right)
            and all(_is_near(said[k], right[k]) for k in right)
        )
    if isinstance(right, list):
        return (
            isinstance(said, list) and len(said) == len(right) and all(map(_is_near, said, right))
        )
    return is_finite(said) and math.isclose(said, right, rel_tol=0.01, abs_tol=0.01)
