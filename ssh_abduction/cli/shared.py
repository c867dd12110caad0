"""What several verbs share: options, and the theories, traces and maps that they name."""

from __future__ import annotations

import argparse
import inspect
import os
import re
import sys
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from ssh_abduction.cli.parsing import LIVE, MAPS, RUN, TRACE, Rows, maps_path, rows_of
from ssh_abduction.data.corrections import ASSERTED, ASSERTIONS, load_corrections
from ssh_abduction.data.drives import step_named
from ssh_abduction.data.errors import AbductionError, MapError, TheoryError, brief, named
from ssh_abduction.data.map_parts import read_json
from ssh_abduction.data.schema import only_known
from ssh_abduction.data.trace import Trace
from ssh_abduction.data.words import meant
from ssh_abduction.rivals.listing import Listing
from ssh_abduction.solution import trace_in
from ssh_abduction.theory.fields import CHOICES
from ssh_abduction.theory.theory import PRESETS, SETTLED, Theory

Step = TypeVar("Step")  # a step by its number or its name

# The arguments that name files to read, and the options that name files to write.
READ = ("trace", "traces", "log", "logs", "maps", "other", "world", "graph")
WRITTEN = ("output", "joint_trace")
# Endings that say what is in a file.
ENDINGS = re.compile(
    r"\.(bag|mcap|log|clf|html?|png|pdf|svg|jsonl|ya?ml|geojson|osm|graphml|dot|gv)"
)


def theory_rows(default: str = "topological") -> Rows:
    """Make the rows that choose a theory: a preset or a file, and options for single fields.

    `default` says in the help which theory is used if the user names none.
    """
    rows: dict[str, str | tuple[str, Mapping[str, Any]]] = {**rows_of("THEORY")}
    said = str(rows["--theory PRESET|FILE"])
    rows["--theory PRESET|FILE"] = said.format(presets=", ".join(PRESETS), default=default)
    for name, text in ASSERTED.items():
        said = f"assume that steps I and J {text}"
        rows[f"--{name.replace('_', '-')} I,J"] = said, {"action": "append"}
    values = {"rules": "FILE..."}
    by_type = {bool: "true|false", int: "N", float: "NUMBER"}
    for field in fields(Theory):
        if field.name not in (*ASSERTIONS, *SETTLED):
            value = values.get(field.name) or by_type.get(type(field.default), "NAMES")
            if field.name in CHOICES:
                value = f"{{{','.join(CHOICES[field.name])}}}"
            rows[f"--set {field.name} {value}"] = helps().get(field.name, field.name)
    return rows


def helps() -> dict[str, str]:
    """Read the help text of each field of Theory from the docstring of that class.

    As in other help texts, the first letter is small.
    """
    # Python 3.13 stores docstrings without indentation.
    _, _, attributes = inspect.cleandoc(Theory.__doc__ or "").partition("Attributes:")
    entries = re.findall(r"^ {4}(\w+): (.+(?:\n {8}.+)*)", attributes, re.MULTILINE)
    words = {name: " ".join(text.split()).rstrip(".") for name, text in entries}
    rules = (
        "a file of your own rules for clingo, written with the predicates of the encodings; may be "
        "given again"
    )
    return {**{name: text[0].lower() + text[1:] for name, text in words.items()}, "rules": rules}


def check_output(target: str, what: str) -> None:
    """Raise AbductionError before long work if a file cannot be written into its folder."""
    folder, path = Path(target).absolute().parent, Path(target)
    if target == "-" or not (path.is_dir() or path.is_file() or not path.exists()):
        return  # a device such as /dev/null is written directly, not by a temporary file beside it
    why = ""
    if path.is_dir():
        why = "it is a folder; name a file in it"
    elif not folder.is_dir():
        why = "its folder is not there; make it first"
    elif not os.access(folder, os.W_OK):
        why = "its folder may not be written; name another one"
    if why:
        raise AbductionError(f"{named(target)}: cannot write {what}: {why}")


def check_ending(target: str, *own: str) -> None:
    """Raise AbductionError if the ending of a file names another format than will be written.

    `own` are the endings of the format. Endings that name no format are allowed.
    """
    ending = Path(target.removesuffix(".gz")).suffix.lower()
    if ENDINGS.fullmatch(ending) and ending not in own:
        raise AbductionError(
            f"{named(target)}: expected a name that ends in {' or '.join(own)}, as its content is "
            f"of this format, got {ending}; rename it"
        )


def check_inputs_are_kept(options: argparse.Namespace) -> None:
    """Raise AbductionError if a command would write to a file that it reads by its arguments.

    Only `cluster` may: it reads a trace, and writes the same trace with views.
    """
    given = vars(options)
    files = list[str]()
    for read in (given.get(name) for name in READ if options.verb != "cluster"):
        files += [read] if isinstance(read, str) else read if isinstance(read, list) else []
    for target in filter(None, (given.get(name) for name in WRITTEN)):
        for file in files:
            if os.path.isfile(target) and os.path.exists(file) and os.path.samefile(target, file):
                raise AbductionError(
                    f"{named(target)}: expected another file to write than the one to read, got "
                    "the same one; name another file"
                )


def write_trace(trace: Trace, target: str, said: str) -> None:
    """Write a trace to a file, and print a message.

    If the file is "-", the trace goes to standard output, and the message to stderr.
    """
    if target == "-":
        sys.stdout.writelines(line + "\n" for line in trace.to_lines())
        print(said, file=sys.stderr)
    else:
        trace.save(target)
        print(f"{said} in {named(target)}")


def trace_of(options: argparse.Namespace) -> str:
    """Return the trace file of a verb whose trace may stand beside its maps.

    Raises AbductionError if there is no trace, or the file of maps cannot be read.
    """
    if options.trace is None and (beside := trace_beside(options.maps)) is not None:
        return beside
    if options.trace is None:
        if options.maps != "-":
            read_maps(options.maps)  # a file that is missing or holds no maps is said first
        raise AbductionError(
            f"trace: expected the trace of {named(options.maps)}, got none; name it after the maps"
        )
    return str(options.trace)


def mapped_trace(maps: str, file: str | None = None) -> Trace | None:
    """Load the trace of some maps: the named file, or the trace beside the maps or in their file.

    The trace in the file of maps has no images and no truth. None if there is no trace. Raises
    AbductionError.
    """
    file = file or trace_beside(maps)
    return Trace.load(file) if file else trace_of_maps(maps)


def solved_trace(options: argparse.Namespace) -> Trace:
    """Load the trace that was solved, as `mapped_trace`. Raises AbductionError if there is none."""
    return mapped_trace(options.maps, options.trace) or Trace.load(trace_of(options))


def trace_of_maps(file: str) -> Trace | None:
    """Return the trace that solve -o put into a file of maps; None if it has none.

    Raises TraceError.
    """

    try:
        data = read_json(file) if file != "-" else None
    except MapError:
        return None
    return trace_in(data, named(file)) if isinstance(data, dict) else None


def trace_beside(maps: str) -> str | None:
    """Return the trace file beside a file of maps that the verb map or live wrote; else None."""
    folder = Path(maps).parent
    is_written = Path(maps).name == MAPS and any((folder / f).is_file() for f in (RUN, LIVE))
    return str(folder / TRACE) if is_written and (folder / TRACE).is_file() else None


def check_picture(file: str | None) -> None:
    """Check before long work that a figure can be drawn. Raise AbductionError if it cannot."""
    if file is not None:
        from ssh_abduction.evaluation.figures import require_matplotlib

        require_matplotlib()


def draw_plot(options: argparse.Namespace, name: str, *data: object) -> None:
    """Draw a figure into the file of --plot, if one is named, by a function of `figures`."""
    if options.plot:
        sys.stdout.flush()  # print first, in case drawing fails
        from ssh_abduction.evaluation import figures

        getattr(figures, name)(options.plot, *data)


def listing_of(file: str) -> Listing:
    """Read the maps in a file, at least one, with the names that a person gave. Raises MapError."""
    where = "standard input" if file == "-" else named(file)
    return Listing.from_dict(read_maps(file), where).named_beside(file)


def refuse(options: argparse.Namespace, beside: str, *names: str) -> None:
    """Raise AbductionError if one of the named options is given beside what `beside` names."""
    for name in names:
        if getattr(options, name) not in (None, False):
            raise AbductionError(
                f"--{name.replace('_', '-')}: expected no such option with {beside}; leave it out"
            )


def check_jobs(jobs: int | None, things: str) -> None:
    """Raise AbductionError if the option --jobs is 0."""
    if jobs == 0:
        raise AbductionError(
            f"--jobs: expected a number of {things}, or -1 for one per core, got 0; leave it out "
            "for 1"
        )


def read_maps(file: str, mend: str = "name the maps first, and then the trace") -> Any:
    """Read the JSON in a file of maps; "-" for standard input.

    Raises MapError. If the file is a trace, the message advises what `mend` says.
    """
    try:
        return read_json(file)
    except MapError:
        if Path(file).suffix in (".yaml", ".yml") and _is_read(load_corrections, file):
            raise MapError(
                f"{named(file)}: expected a file of maps or its folder, got a file of corrections; "
                f"name the folder: {Path(file).parent}"
            ) from None
        if file == "-" or not _is_read(Trace.load, file):
            raise
        raise MapError(f"{named(file)}: expected a file of maps, got a trace; {mend}") from None


def _is_read(load: Callable[[str], object], file: str) -> bool:
    """Whether a function reads a file without an error."""
    with suppress(AbductionError):
        load(file)
        return True
    return False


def theory_of(options: argparse.Namespace, found: Theory | None = None) -> Theory:
    """Return the theory that the options name, or `found`, with the fields that the user changed.

    If `found` is None, the default theory takes its place. Raises TheoryError if a field has a
    wrong value or contradicts another one, and MapError if the file of --theory holds no theory.
    """
    chosen = choices_of(options)
    named_theory: str | None = options.theory
    if named_theory is None and found is not None:
        return found.replace(**chosen)
    if named_theory is None:
        named_theory = "causal" if chosen.get("level") == "causal" else "topological"
    if named_theory in PRESETS:
        return PRESETS[named_theory]().replace(**chosen)
    if named_theory.endswith(".toml"):
        return Theory.from_toml(named_theory).replace(**chosen)
    named_theory = maps_path(named_theory)
    if not (named_theory.endswith(".json") or Path(named_theory).is_file()):
        hint = meant(named_theory, PRESETS)
        raise TheoryError(
            f"--theory: expected {', '.join(PRESETS)}, a .toml file, or a file of maps, "
            f"got {brief(named_theory)}; name one of them{hint}"
        )
    return theory_of_maps(read_json(named_theory), named_theory).replace(**chosen)


def written_theory(data: Any) -> Theory | None:
    """Return the theory with which maps were made, from the data of their file; None if unknown."""
    written = data.get("theory") if isinstance(data, dict) else None
    return None if written is None else Theory.from_dict(written)


def theory_of_maps(data: Any, file: str) -> Theory:
    """Return the theory with which maps were made, from their data. Raises MapError if unknown."""
    if (theory := written_theory(data)) is None:
        raise MapError(
            f"{named(file)}: theory: expected the theory that the maps were made with, got none; "
            "take what solve --json printed"
        )
    return theory


def number_steps(options: argparse.Namespace, trace: Trace) -> None:
    """Replace each step with a drive, such as tuesday:14, by its number, in --same and the like.

    Raises TraceError if the trace has no such drive or step.
    """
    for name in ASSERTIONS:
        pairs = getattr(options, name) or []
        for i, pair in enumerate(pairs):
            if ":" in pair:
                steps = at_comma(pair, partial(step_named, trace))
                pairs[i] = ",".join(map(str, steps))


def at_comma(pair: str, read: Callable[[str], Step]) -> list[Step]:
    """Read the steps that a comma separates. The names of drives may have commas, too."""
    for comma in re.finditer(",", pair):
        with suppress(AbductionError):
            return [read(pair[: comma.start()].strip()), read(pair[comma.end() :].strip())]
    return [read(step.strip()) for step in pair.split(",")]


def choices_of(options: argparse.Namespace) -> dict[str, Any]:
    """Collect the fields of a theory that the user set, by name."""
    chosen = only_known(**{f.name: getattr(options, f.name, None) for f in fields(Theory)})
    if "prefer" in chosen and not chosen["prefer"]:
        chosen["prefer"] = ()
    return chosen
