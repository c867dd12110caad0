"""Write maps and solutions as text for a terminal.

A dstate (distinctive state) is a place and a heading.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from textwrap import indent
from typing import TYPE_CHECKING

from ssh_abduction.data.drives import drives_of, floors_in_words, named_steps
from ssh_abduction.data.errors import printable
from ssh_abduction.data.groups import gathered
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Trace
from ssh_abduction.data.words import counted as counted  # noqa: PLC0414 - the verbs have it from here
from ssh_abduction.data.words import noun_of
from ssh_abduction.explain.no_map import Explanation
from ssh_abduction.output.cards import table_of_dstates
from ssh_abduction.rivals.listing import Listing
from ssh_abduction.solution import Backbone, Solution, Status, steps_in_words, stretches, summary_of

if TYPE_CHECKING:
    from ssh_abduction.rivals.comparison import Choice, Comparison
    from ssh_abduction.rivals.questions import Matter, Question

# The largest number of pairs of steps, questions of a choice, and options of a choice to print.
SHOWN_PAIRS = SHOWN_QUESTIONS = SHOWN_OPTIONS = 12
# Words for what two maps differ in, in singular and plural.
NOUNS: dict[Matter, tuple[str, str]] = {
    "faults": ("fault", "faults"),
    "dstates": ("dstate", "dstates"),
    "places": ("place", "places"),
    "paths": ("path", "paths"),
    "courses": ("direction along the path", "directions along paths"),
}


def answer_lines(
    solution: Solution, explanation: Explanation | None, existing: SSHMap | None = None
) -> Iterator[str]:
    """Yield the lines that describe the result of a search to people.

    `existing` is the map to which drives were added, if there was one.
    """
    if solution.cost is not None:
        yield solution.verdict
    yield headline(solution, explanation)
    yield from by_displacements(solution)
    if solution.joined:
        yield printable((_kept(existing, solution) if existing else "") + solution.joined)
    if solution.maps and (floors := floors_in_words(solution.maps[0])):
        yield floors
    if solution.weighed is None and solution.sureness:  # else the headline says it
        yield solution.sureness
    if solution.status is Status.UNSATISFIABLE:
        if explanation and solution.trace is not None:
            yield from explanation.sentences
            first, last = map(solution.trace.at, (explanation.first, explanation.last))
            where = f"at {last}" if first == last else f"from {first} to {last}"
            mend = (
                "leave one of these axioms out: --set without=NAME"
                if explanation.clashes
                else "explain a trace of these steps alone: ssh-abduction explain"
            )
            yield f"look at what was seen and done {where}, or {mend}"
        return
    if solution.cost is None:
        if partial_map := solution.partial:
            steps = len(partial_map.dstate_at)
            first = "step" if steps == 1 else f"{steps} steps"
            yield f"\nbest map of the first {first}\n{describe(partial_map)}"
        return
    backbone, held = solution.shared, len(solution.maps)
    # The search may have found more maps than the solution holds.
    count = max(sum(level.count for level in solution.levels), held)
    yield f"\n{'map 1' if count > 1 else 'map'}\n{describe(solution.maps[0])}"
    if backbone and (count > 1 or not solution.complete):
        yield f"\n{summary_of(solution, count, backbone)}"
    if backbone and not solution.minimal_listed and solution.trace is not None:
        yield describe_backbone(backbone, solution.trace)
    if held > 1:
        from ssh_abduction.rivals.comparison import compare  # loads numpy

        some = "" if count == held else f" (of the first {held} found)"
        yield f"\nwhat tells the maps apart{some}"
        yield from compared(compare(Listing(solution.maps, drives=solution.drives)))


def headline(solution: Solution, explanation: Explanation | None) -> str:
    """Write one line about how a search ended."""
    if explanation:
        return f"{solution.status.value}: {explanation}"
    if solution.status is Status.UNSATISFIABLE:
        return f"{solution.headline}; to find out why: ssh-abduction explain"
    given = f"{solution.effort.prefix} of {counted(solution.steps, 'steps')} given to clingo"
    sure = f"{solution.weighed.sentence}; " if solution.cost and solution.weighed else ""
    return f"{solution.headline}; {sure}{solution.seconds.total:.2f} s, {given}"


def _kept(existing: SSHMap, solution: Solution) -> str:
    """Say whether drives that were added to a map joined its pieces."""
    found, names = solution.maps[0], ", ".join(solution.support.onto)
    piece_of = found.piece_of
    left = {piece_of[s] for s in found.dstate_at[: len(existing.dstate_at)]}
    pieces = len(existing.pieces)
    if len(left) == pieces:
        return f"the map of {names} is kept; "
    return f"the {pieces} pieces of the map of {names} are kept, and joined to {len(left)}; "


def by_displacements(solution: Solution) -> Iterator[str]:
    """Yield lines about displacements: what they exclude, and how well the maps fit them.

    There are no lines if displacements are not used.
    """
    said = solution.effort.evidence.get("displacement")
    if said is None:
        return
    sets = f" and {counted(said['refused'], 'sets')} of two returns" if said["refused"] else ""
    text = f"displacements: they exclude {counted(said['pairs'], 'pairs')} of steps{sets}"
    best = solution.maps[0].fit if solution.maps else None
    if best is not None:
        which = "the map" if solution.count == 1 else "map 1, which fits best,"
        text += (
            f"; {which} fits them with a chi-square of {best.chi2:.1f} for {best.dof} degrees of "
            f"freedom (p = {best.p:.2g})"
        )
        if best.scale or best.bend:
            text += (
                f", if reported distances are {100 * best.scale:+z.1f} % off and headings drift by "
                f"{math.degrees(best.bend):+z.3f} degrees per metre"
            )
    yield text


def table(head: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """Write a table with aligned columns. Control characters are escaped."""
    cells = [[*head], *([printable(str(cell)) for cell in row] for row in rows)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    lines = ([cell.ljust(w) for cell, w in zip(row, widths, strict=True)] for row in cells)
    return "\n".join(f"  {'  '.join(line)}".rstrip() for line in lines)


def describe(ssh_map: SSHMap) -> str:
    """Write a map as text: each path with its places in order, and each dstate with its links."""
    parts = []
    if ssh_map.faults:
        faults = "; ".join(printable(str(fault)) for fault in ssh_map.faults)
        parts.append(f"  {counted(len(ssh_map.dstates), 'dstates')}, and {faults}")
    for p in ssh_map.paths:
        order = " – ".join(ssh_map.numbered("place", place) for place in p.order)
        parts.append(printable(f"  {ssh_map.called('path', p.id)}: places {order}"))
    if ssh_map.excused:
        said = "  side_of_branch is not applied to paths"
        parts += [f"{said} {h} and {g}" for h, g in ssh_map.excused]
    return "\n".join([*parts, table(*table_of_dstates(ssh_map))])


def describe_backbone(backbone: Backbone, trace: Trace) -> str:
    """Write what the minimal maps share.

    A table lists the steps that are one dstate in all maps. Then come pairs of steps that are one
    dstate, or at one place, in some maps only.
    """
    names = named_steps(drives_of(trace), len(trace))
    rows = []
    for steps in gathered(zip(backbone.dstates.always, names, strict=True)).values():
        seen = next((v for t in steps if (v := trace.steps[t].view) is not None), "?")
        rows.append([seen, stretches(steps)])
    maps = "minimal maps" if backbone.proven else "maps found"
    parts = [table(["view", f"steps at one dstate in all {maps}"], rows)]
    for sort, pairs in (
        ("one dstate", backbone.dstates.sometimes),
        ("at one place", backbone.places.sometimes if backbone.places else ()),
    ):
        if pairs:
            more = f", and {len(pairs) - SHOWN_PAIRS} more" if len(pairs) > SHOWN_PAIRS else ""
            listed = ", ".join(f"{names[i]} and {names[j]}" for i, j in pairs[:SHOWN_PAIRS])
            parts.append(f"  {sort} in some of them: the steps {listed}{more}")
    return "\n".join(parts)


def compared(found: Comparison) -> Iterator[str]:
    """Yield lines about how maps differ: the choices, their options, and the questions to ask.

    A choice is a set of questions that maps answer differently. An option is one way to answer
    them. There are no lines if the maps do not differ.
    """
    number = {question: i for i, question in enumerate(found.deciding, 1)}
    if found.product:
        yield f"  {found.product}: each combination of these choices is a map"
    for choice in found.choices:
        yield from _choice_in_words(choice, number, len(found.ids))
    if found.together:
        yield f"  these depend on several choices: {depending(found.together)}"
    if not found.deciding:
        return
    causes = sum(question.sort in ("faults", "dstates") for question in found.deciding)
    questions, some = "question 1 tells", ""
    if len(found.deciding) > 1:
        questions = f"questions 1 to {len(found.deciding)}, asked in this order, tell"
    if 0 < causes < len(found.deciding):
        first = f"1{f' to {causes}' * (causes > 1)}"
        some = f", and {first} the {found.variants['dstates']} labelings"
    maps = "both maps" if len(found.ids) == 2 else f"all {counted(len(found.ids), 'maps')}"
    yield f"  {questions} {maps} apart{some}"


def _choice_in_words(choice: Choice, number: Mapping[Question, int], maps: int) -> Iterator[str]:
    """Yield lines about a choice: its questions, with their numbers, and its options.

    `maps` is the number of all maps that are compared.
    """
    yield f"  {counted(len(choice.options), 'options')} for {depending(choice.differing)}"
    index = {question: k for k, question in enumerate(choice.questions)}
    asked = sorted(choice.questions, key=number.__getitem__)
    for question in asked[:SHOWN_QUESTIONS]:
        options = (option for option in choice.options if option.answers[index[question]])
        yes = sorted(i for option in options for i in option.maps)
        where = f"{noun_of('map', yes)} {stretches(yes)} ({len(yes)} of {maps})"
        yield f"    question {number[question]}: {question}: in {where}"
    if len(asked) > SHOWN_QUESTIONS:
        yield f"    and {counted(len(asked) - SHOWN_QUESTIONS, 'more questions')}; --json has them"
    elif len(asked) > 1 and len(choice.options) <= SHOWN_OPTIONS:
        rows = [
            [*("yes" if option.answers[index[q]] else "no" for q in asked), stretches(option.maps)]
            for option in choice.options
        ]
        head = [*(f"{number[q]}." for q in asked), "maps"]
        yield indent(table(head, rows), "    ")


def depending(differing: Mapping[Matter, Sequence[int]]) -> str:
    """Say what differs, such as "the dstates of steps 48 and 51; the paths of step 66"."""
    shown = {
        sort: steps
        for sort, steps in differing.items()
        if sort != "courses" or not set(steps) <= set(differing.get("paths", ()))
    }
    return "; ".join(
        f"the {NOUNS[sort][len(steps) > 1]} of {steps_in_words(steps)}"
        for sort, steps in shown.items()
    )
