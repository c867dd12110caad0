"""Make a search obey the corrections of a person, and report how it did."""

from __future__ import annotations

import argparse
import contextlib
import math
import sys
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ssh_abduction.cli.outcome import warn
from ssh_abduction.data.corrections import (
    ASSERTIONS,
    FILE,
    Corrections,
    Passage,
    Said,
    beside,
    load_corrections,
    save_corrections,
)
from ssh_abduction.data.drives import drives_of, fingerprints_of, step_of, together
from ssh_abduction.data.errors import MapError, TheoryError, named, printable
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Trace
from ssh_abduction.data.words import counted
from ssh_abduction.explain.no_map import Explanation, explain
from ssh_abduction.solver import (
    Limits,
    Solution,
    Status,
    obeyed,
    solve,
    with_correction_warnings,
    with_names,
)
from ssh_abduction.theory.theory import Theory


def corrections_of(options: argparse.Namespace) -> Corrections | None:
    """Read the corrections of --corrections, or beside the output or the maps of --onto, if any."""
    file = options.corrections or beside(options.output) or beside(options.onto)
    return None if file is None else load_corrections(file)


def as_corrected(
    trace: Trace, theory: Theory, maps: str | None, given: str | None = None
) -> tuple[Trace, Theory]:
    """Apply the corrections beside a file of maps to a trace and a theory, and return both.

    `given` is a file of corrections that the user names instead. The number of corrections obeyed
    is printed on stderr. If the file beside the maps is of other drives, it is ignored with a
    warning. Raises MapError if the file is malformed or contradicts the trace, or if `given` is of
    other drives.
    """
    file = given or beside(maps)
    said = Corrections() if file is None else load_corrections(file)
    if not said.pairs and not said.gateways:
        return trace, theory
    if given is None:
        try:
            said.check_drives(dict(fingerprints_of(trace)))
        except MapError as error:
            warn([f"{error}; it is not obeyed"])
            return trace, theory
    corrected = obeyed(said, trace, theory)
    say_obeyed(said, trace)
    return corrected


def say_obeyed(said: Corrections, trace: Trace) -> None:
    """Print on stderr how many corrections are about drives of this trace."""
    here = len([*sentences_of(said.known_in(drives_of(trace)))])
    more = len([*sentences_of(said)]) - here
    aside = f"; {more} more {'is' if more == 1 else 'are'} about other drives" if more else ""
    text = f"obeying {counted(here, 'corrections')} of {named(said.source)}{aside}"
    print(printable(text), file=sys.stderr)


def keep_corrections(said: Corrections | None, output: str | None) -> None:
    """Write the corrections that were obeyed beside a new file of maps, if it has none yet."""
    if said is not None and output is not None and output != "-" and beside(output) is None:
        copy = Path(output).parent / FILE
        save_corrections(said, copy)
        print(printable(f"copied {named(said.source)} to {named(copy)}"), file=sys.stderr)


@dataclass(frozen=True)
class Obeying:
    """The corrections that a search obeys."""

    corrections: Corrections
    trace: Trace  # the trace, with its stars corrected
    theory: Theory  # the theory, with the pairs of steps that a person asserts
    as_seen: Trace  # the trace as it was recorded
    without: Theory  # the theory without these pairs

    @classmethod
    def of(cls, options: argparse.Namespace, trace: Trace, theory: Theory) -> Obeying:
        """Read the corrections of --corrections, or those beside the output. Raises MapError."""
        said = corrections_of(options)
        if said is None:
            return cls(Corrections(), trace, theory, trace, theory)
        corrected = cls(said, *obeyed(said, trace, theory), trace, theory)
        say_obeyed(said, trace)
        return corrected

    def named(self, ssh_map: SSHMap) -> SSHMap:
        """Return a map with the names that a person gave."""
        return self.corrections.named(ssh_map, drives_of(self.trace))

    def with_names(self, solution: Solution) -> Solution:
        """Return a solution whose maps have the names that a person gave."""
        return with_names(self.corrections, solution, self.trace)

    def finished(self, solution: Solution, limits: Limits) -> Solution:
        """Add names, and warn of drives that share no place because of a corrected gateway."""
        counts = limits.work_limit is not None
        limit = limits.work_limit if counts else limits.time_limit
        spent = solution.effort.work if counts else solution.seconds.total
        left = math.inf if limit is None else limit - (spent or 0.0)

        def find(trace: Trace, theory: Theory, most: float) -> Solution:
            limited: dict[str, Any] = {"work_limit" if counts else "time_limit": most}
            return solve(trace, theory, max_maps=1, **limited)

        return with_correction_warnings(self.corrections, self.with_names(solution), left, find)

    def blamed(self, solution: Solution, explanation: Explanation | None) -> list[str]:
        """List the corrections that may be the reason why the trace has no map.

        Each correction is dropped in turn. If the steps of the explanation still have no map, this
        correction is not to blame, and it is not listed. Without an explanation, two steps that
        are said to be one are compared.
        """
        if solution.maps or not self.corrections:
            return []
        said = self.corrections.known_in(drives_of(self.trace))
        source = named(said.source or "corrections")
        if explanation is None:
            sure = [
                f"{source}: {pair}: it contradicts the trace{seen_at(pair, self.trace)}"
                for pair in said.pairs
                if clash_alone(pair, self.trace, self.without)
            ]
            if sure or solution.status is not Status.UNSATISFIABLE:
                return sure
            return [
                f"{source}: {sentence}: perhaps it contradicts the trace"
                for sentence in (*said.pairs, *said.gateways)
            ]
        # Drop corrections one by one, as long as there is still no map. Those left clash.
        stretch = range(explanation.first, explanation.last + 1)
        kept = replace(said, pairs=(), gateways=())
        if self._has_no_map(kept, stretch):
            return []
        kept = said
        sentences: list[Said | Passage] = [*said.pairs, *said.gateways]
        for sentence in sentences:
            fewer = kept.without(sentence)
            kept = fewer if self._has_no_map(fewer, stretch) else kept
        wrong = [one for one in sentences if one in kept.pairs or one in kept.gateways]
        others = ", or another correction that is named here" if len(wrong) > 1 else ""
        return [
            f"{source}: {sentence}: it contradicts the trace{seen_at(sentence, self.trace)}{others}"
            for sentence in wrong
        ]

    def how_to_mend(self, blamed: Sequence[str], explanation: Explanation | None) -> Iterator[str]:
        """Yield a line that says how to mend the corrections of `blamed`, if there are any."""
        if not blamed:
            return
        said = self.corrections.known_in(drives_of(self.trace))
        lenient = misreading(self.without)
        if lenient is None:
            helps = False
        elif explanation is None:
            pairs = [p for p in said.pairs if clash_alone(p, self.trace, self.without)]
            helps = bool(pairs) and not any(clash_alone(p, self.trace, lenient) for p in pairs)
        else:
            stretch = range(explanation.first, explanation.last + 1)
            helps = not self._has_no_map(said, stretch, lenient)
        them = "this correction" if len(blamed) == 1 else "one of these corrections"
        also = ", or let views and stars be misread: solve with --set misread=4" if helps else ""
        yield f"say the opposite of {them} (ssh-abduction correct), or delete it{also}"

    def _has_no_map(self, said: Corrections, stretch: range, without: Theory | None = None) -> bool:
        trace, theory = obeyed(said, self.as_seen, without or self.without)
        part = theory.of_steps(stretch.start, len(stretch))
        # In these steps, every view may be unknown.
        part = part.replace(unknown_views=None in trace.views)
        return explain(trace[stretch.start : stretch.stop], part) is not None


def misreading(theory: Theory) -> Theory | None:
    """Return the theory with misread views and stars; None if it allows or cannot allow them."""
    with contextlib.suppress(TheoryError):
        return None if theory.misread else theory.replace(misread=4)
    return None


def clash_alone(said: Said, trace: Trace, theory: Theory) -> bool:
    """Whether two steps that are said to be one dstate or place cannot be so by themselves."""
    if not said.kind.startswith("same"):
        return False
    drives = drives_of(trace)
    steps = sorted(step_of(drives, step) for step in said.steps)
    alone = [trace[t : t + 1].without_displacements() for t in steps]
    nothing: dict[str, Any] = dict.fromkeys(ASSERTIONS, ())
    theory = theory.replace(displacement="none", weigh="auto", **{**nothing, said.kind: ((0, 1),)})
    with warnings.catch_warnings():  # of drives that are equal, or have nothing in common
        warnings.simplefilter("ignore")
        return explain(together(alone, ["first", "second"]), theory) is not None


def seen_at(said: Said | Passage, trace: Trace) -> str:
    """Say what the robot saw at two steps that are said to be one dstate, if this differs."""
    if isinstance(said, Passage) or not said.kind.startswith("same"):
        return ""
    drives = drives_of(trace)
    first, second = (trace.steps[step_of(drives, step)] for step in said.steps)
    if said.kind == "same" and first.view != second.view:
        seen = ("no view" if step.view is None else step.view for step in (first, second))
        return f" ({', '.join(f'{s} shows {v}' for s, v in zip(said.steps, seen, strict=True))})"
    return " (their stars differ)" if first.star != second.star else ""


def sentences_of(corrections: Corrections) -> Iterator[str]:
    """Put corrections into words: yield one sentence for each."""
    yield from map(str, (*corrections.names, *corrections.pairs, *corrections.gateways))
