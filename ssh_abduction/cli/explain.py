"""ssh-abduction explain TRACE [STEP STEP]: why two steps are one dstate or not.

Without steps, it explains why the trace has no map. With a place and a path, it explains on which
side of the path the place lies. With a place alone, it does so for all paths.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from ssh_abduction.cli.guard import Guard
from ssh_abduction.cli.obeyed_corrections import as_corrected
from ssh_abduction.cli.options import (
    add_limits,
    add_max_maps,
    add_theory,
    maps_path,
    number_steps,
    theory_of,
    theory_of_maps,
    trace_beside,
    trace_of_maps,
    trace_path,
)
from ssh_abduction.cli.outcome import on_ctrl_c
from ssh_abduction.cli.parsing import Verbs
from ssh_abduction.data.drives import step_named
from ssh_abduction.data.errors import AbductionError, brief, named
from ssh_abduction.data.files import json_line
from ssh_abduction.data.map_file import read_json
from ssh_abduction.data.map_parts import thing_named
from ssh_abduction.data.trace import Trace
from ssh_abduction.data.words import meant
from ssh_abduction.explain.no_map import TraceExplanation, TraceQuestion
from ssh_abduction.explain.pair_reasons import PairQuestion
from ssh_abduction.explain.place_reasons import PlaceExplanation, PlaceQuestion
from ssh_abduction.explain.verdict import PairExplanation, Verdict
from ssh_abduction.runtime.program import interrupted_code
from ssh_abduction.solver import Stop
from ssh_abduction.theory.theory import Theory

if TYPE_CHECKING:
    from ssh_abduction.rivals.listing import Listing, PairInMap

EXIT_NO_MAP, EXIT_UNKNOWN = 20, 30
SECONDS = 60.0  # the default time limit: joint maps with changes may need hours for a proof

Answer: TypeAlias = PairExplanation | TraceExplanation | PlaceExplanation


def add_parser(verbs: Verbs) -> None:
    parser = verbs.add(
        "explain",
        run,
        "say why two steps are one dstate or two, or why there is no map",
        "Explain why two steps of a trace are one dstate in every map, or different dstates "
        "in every map, and name the axioms that force it. If maps differ in this, report which "
        "maps have one dstate and which have two, and the cost of either. Without steps, explain "
        "why the trace has no map, and which single observation could be wrong. With a place such "
        "as p7, and perhaps a path such as path2, say on which side of the path the place lies, "
        "and which turn shows it.",
        "Exit codes: 0 explained; 20 the trace has no map; 30 no explanation in time; 1, 2, 130 "
        "and 143 as for the other commands.",
    )
    parser.add(
        "trace",
        "trace file (JSON Lines), or - for standard input. Or a file of maps that solve -o wrote, "
        "or a folder that the command 'map' wrote: then the trace and theory of these maps are "
        "used",
    )
    parser.add(
        "steps",
        "what to explain. Two steps (numbers from 0, or DRIVE:STEP in a joint trace): why they are "
        "one dstate or two. A place and a path, such as p7 path2: on which side of the path the "
        "place lies. A place alone: its side of each path, and its regions. Nothing: why the trace "
        "has no map. Numbers of places and paths are those of the first minimal map, or of the "
        "first map in a file of maps. In a file, places and paths may also be given by name",
        nargs="*",
        default=(),
        metavar="step",
    )
    add_max_maps(parser, "minimal maps, to count those in which the two steps are one dstate")
    parser.add("--json", "print the explanation as JSON")
    add_limits(parser, "what is known", SECONDS)
    parser.add(
        "--corrections FILE",
        "obey the corrections in this file, or in corrections.yaml of this folder (default: "
        "corrections.yaml in the folder of the file that --theory names, if there is one)",
    )
    add_theory(parser)


def run(options: argparse.Namespace) -> int:
    if not Path(trace_path(options.trace)).exists():  # a folder with a file of solve -o
        options.trace = maps_path(options.trace)
    if trace_beside(options.trace):  # the file of maps in a folder that map wrote
        options.trace = str(Path(options.trace).parent)
    kept = trace_of_maps(options.trace)
    if kept is not None or Path(options.trace).is_dir():
        options.theory = options.theory or maps_path(options.trace)
    trace = Trace.load(trace_path(options.trace)) if kept is None else kept
    number_steps(options, trace)
    maps, found, data = _maps_of(options)
    trace, theory = as_corrected(trace, theory_of(options, found), maps, options.corrections)
    limits: dict[str, Any] = {n: getattr(options, n) for n in ("time_limit", "memory_limit")}
    listing = _listing_of(maps, data, len(trace)) if found and options.steps else None
    if listing is not None:
        limits["known"] = listing.maps
    of_place = _place_asked(options.steps, listing)
    question: PairQuestion | TraceQuestion | PlaceQuestion
    pair: PairInMap | None = None
    if of_place:
        if listing is not None:
            limits["known"] = listing.maps[: listing.minimal or None]
        question = PlaceQuestion(trace, *of_place, theory, **limits)
    elif options.steps:
        first, second = (step_named(trace, step) for step in options.steps)
        if listing is not None:
            from ssh_abduction.rivals.listing import PairInMap  # loads numpy

            pair = PairInMap.of(listing, first, second)
        limits["max_maps"] = options.maps or None
        question = PairQuestion(trace, first, second, theory, **limits)
    else:
        question = TraceQuestion(trace, theory, **limits)
    as_text = partial(_as_text, pair, options.time_limit)
    written = partial(_as_json, pair) if options.json else as_text

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
    return file, theory_of_maps(data, file), data


def _listing_of(file: str | None, data: Any, steps: int) -> Listing | None:
    """Read the maps in the data of a file; None if it has no maps of a trace with `steps` steps."""
    if file is None or not data.get("maps"):
        return None
    from ssh_abduction.rivals.listing import Listing  # loads numpy

    listing = Listing.from_dict(data, named(file))
    return listing.named_beside(file) if listing.steps == steps else None


def _as_text(in_map: PairInMap | None, seconds: float, explanation: Answer) -> str:
    lines = [*([str(in_map)] if in_map else []), str(explanation)]
    is_limited = explanation.stopped in (None, "time limit")
    if is_limited and _exit_code(explanation) == EXIT_UNKNOWN:
        lines.append(f"undecided within {seconds:g} s; --time-limit gives it more time")
    return "\n".join(lines) + "\n"


def _as_json(in_map: PairInMap | None, explanation: Answer) -> str:
    record = explanation.to_dict()
    return json_line(record | ({"map": in_map.to_dict()} if in_map else {})) + "\n"


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
