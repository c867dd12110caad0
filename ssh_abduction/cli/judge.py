"""ssh-abduction check and explain: which axioms a map breaks, and which force an answer.

`explain` says why two steps are one dstate or not, or why a trace has no map. With a place and a
path, it explains on which side of the path the place lies. With a place alone, it does so for all
paths.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias

from ssh_abduction.checker.checker import Violation, check, unchecked
from ssh_abduction.checker.claims import ProvenBound, check_bound, false_claims
from ssh_abduction.cli import shared
from ssh_abduction.cli.correct import SavedMap, as_corrected
from ssh_abduction.cli.outcome import Guard, on_ctrl_c, warn
from ssh_abduction.cli.parsing import maps_path, trace_path, verb
from ssh_abduction.cli.text import counted
from ssh_abduction.data.drives import fingerprints_of, step_named
from ssh_abduction.data.errors import AbductionError, MapError, brief, is_finite, named, printable
from ssh_abduction.data.files import json_line
from ssh_abduction.data.map_parts import read_json, thing_named
from ssh_abduction.data.maps import SSHMap, maps_of
from ssh_abduction.data.trace import Trace
from ssh_abduction.data.words import meant
from ssh_abduction.explain.no_map import TraceExplanation, TraceQuestion, steps_listed
from ssh_abduction.explain.pair_reasons import PairQuestion
from ssh_abduction.explain.place_reasons import PlaceExplanation, PlaceQuestion
from ssh_abduction.explain.verdict import PairExplanation, Verdict
from ssh_abduction.rivals.listing import Listing, PairInMap
from ssh_abduction.runtime.program import interrupted_code
from ssh_abduction.solution import RESTS_ON, Sharing, Solution, Stop, summary_of
from ssh_abduction.solver import Ranking
from ssh_abduction.theory.fields import AUTO
from ssh_abduction.theory.settle import settle
from ssh_abduction.theory.theory import Theory

EXIT_VIOLATED = 20
ROUNDED = 1e-4  # a claimed probability may be wrong by this much, as costs in files are rounded
SHOWN = 20  # violations that are printed for each map


@dataclass
class _Judgement:
    """What `check` found about the maps in a file."""

    trace: Trace
    data: Any  # the content of the file
    maps: Sequence[SSHMap]
    theory: Theory  # the theory, in which no field is "auto"
    violations: Sequence[Sequence[Violation]]  # the violations of each map
    holds: bool  # whether all maps and claims hold
    # Sentences about everything else that was checked, such as bounds and costs.
    said: list[str]

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
            "sentences": [*map(printable, self.said)],
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
        yield from map(printable, self.said)

    def check_costs(self, where: str) -> None:
        """Recompute the costs of the maps in nats. `where` is the file, for errors."""
        # This loads numpy.
        from ssh_abduction.checker.cost_claims import LONGEST, count_checked_rivals, false_costs

        trace, data, theory = self.trace, self.data, self.theory
        weighed = Solution.from_dict(data, where, trace).weighed  # the fields have the right form
        false = list(false_costs(trace, data, self.maps, theory))
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
        self.said += false
        self.holds &= not false
        rivals = len(data["weighed"]["rivals"])  # the first one is map 1
        checked = max(count_checked_rivals(len(trace), rivals), 1)
        if len(trace) > LONGEST:
            why = f"as the trace has more than {LONGEST} steps"
            self.said.append(f"costs in nats are not checked, {why}")
            return
        if not false:
            others = f" and {counted(checked - 1, 'rivals')}" * (checked > 1)
            self.said.append(
                f"the costs in nats of map 1{others} are right: they were computed anew"
            )
        if rivals > checked:
            more = counted(rivals - checked, "more rivals")
            self.said.append(f"the costs of {more} are not checked, as that would take long")

    def check_bound(self, doubt: str | None, solved: Theory, unproven: str | None) -> None:
        """Check the lower bound and the other claims in the file of maps.

        `doubt` says why clingo's proofs may not hold for this trace and theory, `unproven` why the
        file has no proof of the bound. `solved` is the theory of the file.
        """
        trace, data, maps = self.trace, self.data, self.maps
        bound = None if unproven else check_bound(trace, data["certificate"])
        self.said += [f"bound: {fault}" for fault in bound.faults] if bound else []
        proven = bound.dstates + len(bound.refuted) if bound else sys.maxsize
        false = [
            *false_claims(data, maps, len(trace), solved, proven),
            *_false_of_maps(data, maps, trace),
        ]
        if not false and self.holds and "theory" in data:
            false += _false_of_all(data, trace)
        self.said += false
        self.holds &= not false
        if bound is None:
            self.said += [] if false else ["the other claims of the file agree with its maps"]
            self.said.append(f"that no better map exists is not checked: {unproven}")
        elif bound.faults:
            self.holds = False
        else:
            fewest = min((len(m.dstates) for m in maps), default=sys.maxsize)
            total = bound.dstates + (0 if doubt else len(bound.refuted))
            self.said += _bound_in_words(bound, total, fewest if maps else None, doubt)
            self.holds &= fewest >= total


@verb(theory_rows=shared.theory_rows("the theory of the maps, or topological"))
def run_check(options: argparse.Namespace) -> int:
    """Judge maps by the axioms.

    Check maps against a trace and the axioms, without clingo. Reports each axiom that a map breaks,
    and at which steps.

    Without --theory, the theory in the file of maps is used. The other options change single fields
    of it. Corrections in corrections.yaml beside the maps are obeyed. docs/reference/formats.md
    describes the JSON.
    """
    trace = shared.solved_trace(options)
    data = read_json(options.maps)
    if not _may_be_of(data, trace):
        steps = f"those of {named(trace.source or 'the trace')}"
        warn([f"{named(options.maps)} was made of other steps than {steps}"])
    solved = shared.written_theory(data)
    asked = shared.theory_of(options, solved)
    trace, theory = as_corrected(trace, asked, options.maps)
    theory.check_steps(trace)
    maps = maps_of(data, str(options.maps))
    if not maps and not options.bound:
        raise MapError(
            f"{named(options.maps)}: maps: expected one to check, got none; see the status that "
            "solve printed, or check its bound (--bound)"
        )
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
    found = _Judgement(trace, data, maps, resolved, violations, not any(violations), [])
    if unjudged:
        found.said.append(f"regions are not checked: {why}")
    weighed = data.get("weighed") if isinstance(data, dict) and resolved.weigh == "cost" else None
    if weighed:
        found.check_costs(str(options.maps))
    if options.bound:
        unproven = _why_no_proof(data, resolved, solved)
        doubt = why if other else None
        if not found.holds:
            doubt = "some maps break axioms" if any(violations) else "a claim about costs is false"
        elif solved is None:
            doubt = "the file names no theory"
        found.check_bound(doubt, made_by, unproven)
        if weighed and not unproven:
            least = f"{weighed['bound']:.1f} nats"
            found.said.append(f"that no map costs less than {least} is not checked")
    print(json_line(found.to_dict()) if options.json else "\n".join(found.lines()))
    return 0 if found.holds else EXIT_VIOLATED


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


def _bound_in_words(
    bound: ProvenBound, total: int, fewest: int | None, doubt: str | None
) -> Iterator[str]:
    """Yield sentences about a lower bound of `total` dstates. A map has `fewest`, if there is one.

    `doubt` is as for `check_bound`.
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


EXIT_NO_MAP, EXIT_UNKNOWN = 20, 30
Answer: TypeAlias = PairExplanation | TraceExplanation | PlaceExplanation


@verb({"trace": {"type": str}, "steps": {"default": ()}}, theory_rows=shared.theory_rows())
def run_explain(options: argparse.Namespace) -> int:
    """Say why two steps are one dstate or two, or why there is no map.

    Explain why two steps of a trace are one dstate in every map, or different dstates in every map,
    and name the axioms that force it. If maps disagree, say in which maps they are one dstate, in
    which ones they are two, and what each costs. Without steps, explain why the trace has no map,
    and which single observation could be wrong. With a place such as p7, and perhaps a path such as
    path2, say on which side of the path the place lies, and which turn shows it.

    Exit codes: 0 explained; 20 the trace has no map; 30 no explanation in time; 1, 2, 130 and 143
    as for the other commands.
    """
    if not Path(trace_path(options.trace)).exists():  # a folder with a file of solve -o
        options.trace = maps_path(options.trace)
    if shared.trace_beside(options.trace):  # the file of maps in a folder that map wrote
        options.trace = str(Path(options.trace).parent)
    kept = shared.trace_of_maps(options.trace)
    if kept is not None or Path(options.trace).is_dir():
        options.theory = options.theory or maps_path(options.trace)
    trace = Trace.load(trace_path(options.trace)) if kept is None else kept
    shared.number_steps(options, trace)
    maps, found, data = _maps_of(options)
    trace, theory = as_corrected(trace, shared.theory_of(options, found), maps, options.corrections)
    given: dict[str, Any] = {n: getattr(options, n) for n in ("time_limit", "memory_limit")}
    listing: Listing | None = None
    if maps and options.steps and data and data.get("maps"):
        listing = Listing.from_dict(data, named(maps)).named_beside(maps)
        listing = listing if listing.steps == len(trace) else None
    if listing is not None and maps:
        given["known"] = listing.maps
        options.steps = _with_steps(options.steps, maps)
    of_place = _place_asked(options.steps, listing)
    question: PairQuestion | TraceQuestion | PlaceQuestion
    pair: PairInMap | None = None
    if of_place:
        if listing is not None:
            given["known"] = listing.maps[: listing.minimal or None]
        question = PlaceQuestion(trace, *of_place, theory, **given)
    elif options.steps:
        first, second = (step_named(trace, step) for step in options.steps)
        if listing is not None:
            pair = PairInMap.of(listing, first, second)
        given["max_maps"] = options.maps or None
        question = PairQuestion(trace, first, second, theory, **given)
    else:
        question = TraceQuestion(trace, theory, **given)

    def written(answer: Answer) -> str:
        if options.json:
            in_map = {"map": pair.to_dict()} if pair else {}
            return json_line(answer.to_dict() | in_map) + "\n"
        lines = [*([str(pair)] if pair else []), str(answer)]
        is_limited = answer.stopped in (None, "time limit")
        if is_limited and _exit_code(answer) == EXIT_UNKNOWN:
            seconds = f"{options.time_limit:g} s"
            lines.append(f"undecided within {seconds}; --time-limit gives it more time")
        return "\n".join(lines) + "\n"

    def last_words(why: Stop) -> tuple[str, int]:
        answer = question.known(why)
        return written(answer), _exit_code(answer)

    with (
        on_ctrl_c(question.interrupt),
        Guard(question.interrupt, last_words, options.time_limit, options.memory_limit) as guard,
    ):
        answer = question.answer()
        guard.finish(_exit_code(answer), lambda: written(answer))
    return _exit_code(answer)


def _with_steps(words: Sequence[str], maps: str) -> Sequence[str]:
    """Replace each of two places, in a question without a path, by a step there."""
    if len(words) != 2 or all(word.isdecimal() for word in words):
        return words
    saved = SavedMap.load(maps)
    found = [("place", word) if word.isdecimal() else saved.thing(word) for word in words]
    return words if "path" in dict(found) else [step for _, step in found]


def _place_asked(words: Sequence[str], listing: Listing | None) -> tuple[int, int | None] | None:
    """Return the numbers of the place and of the path that the user asks about; None for steps.

    Names are those of the first listed map. Raises AbductionError if the words are neither.
    """
    names = listing.maps[0].names if listing is not None else ()
    found = [thing_named(word, names) or ("", 0) for word in words]
    kinds = [kind for kind, _ in found]
    if kinds in (["place"], ["place", "path"]):
        return found[0][1], found[1][1] if found[1:] else None
    if len(words) not in (0, 2) or "path" in kinds:
        texts = [name.text for name in names]
        hints = (meant(word, texts, 3) for word, kind in zip(words, kinds, strict=True) if not kind)
        raise AbductionError(
            f"steps: expected two steps, a place, or a place and a path, got "
            f"{brief(' '.join(words))}; name two steps, or a place, as in p7, to learn on which "
            f"side of each path and in which regions it is, or a place and a path, as in "
            f"p7 path2{''.join(hints)}"
        )
    return None


def _maps_of(options: argparse.Namespace) -> tuple[str | None, Theory | None, Any]:
    """Return the file that --theory names, the theory of its maps, and its data.

    All three are None if --theory names no file. A TOML file has no maps: only its name is
    returned. Raises MapError if the file cannot be read, or holds no theory.
    """
    file = maps_path(options.theory) if options.theory else None
    if file is None or not Path(file).is_file():
        return None, None, None
    if file.endswith(".toml"):
        return file, None, None
    data, options.theory = read_json(file), None
    return file, shared.theory_of_maps(data, file), data


def _exit_code(explanation: Answer) -> int:
    """Find the exit code for an explanation, as the help lists them."""
    if explanation.stopped == "interrupted":
        return interrupted_code()
    if isinstance(explanation, PlaceExplanation):
        if explanation.maps:
            return 0
        return EXIT_NO_MAP if explanation.possible is False else EXIT_UNKNOWN
    if isinstance(explanation, PairExplanation):
        no_map, known = explanation.verdict is Verdict.NO_MAP, explanation.proven
    else:
        no_map, known = explanation.possible is False, explanation.possible is not None
    if not known or (no_map and explanation.clash is None):
        return EXIT_UNKNOWN
    return EXIT_NO_MAP if no_map else 0
