"""Check a proof that all maps of a trace have at least some number of dstates.

>>> from ssh_abduction import Trace
>>> from ssh_abduction.checker.proof import check_bound
>>> trace = Trace.from_steps(["a", "b", "a", "c"], ["travel", "travel", "travel"])
>>> check_bound(trace, {"clique": [0, 1, 2, 3], "words": [[0, 2, ["travel"]]], "refuted": []})
ProvenBound(dstates=4, refuted=(), faults=())
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

from ssh_abduction.data.checks import an_object
from ssh_abduction.data.errors import MapError, brief
from ssh_abduction.data.trace import Step, Trace


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
    one view and actions are deterministic. So for each pair of the clique, the check follows a word
    (a list of actions) from both steps along the trace and compares the views at the end. The
    certificate lists the words of pairs. If it has no words at all, the word of a pair is the
    actions that the trace has after both steps. Raises MapError if the certificate is malformed.
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
    word_of, has_words = _words_of(certificate), "words" in certificate
    pairs = list(combinations(steps, 2))
    reasons = (
        word_of.get(frozenset(pair), []) if has_words else _common_actions(trace, *pair)
        for pair in pairs
    )
    faults = [
        fault
        for (i, j), word in zip(pairs, reasons, strict=True)
        if (fault := _not_apart(trace, i, j, word))
    ]
    return ProvenBound(len(steps), tuple(refuted), tuple(faults))


def _words_of(certificate: Mapping[str, Any]) -> dict[frozenset[int], list[str]]:
    """Return the word of each pair of steps for which a certificate has one."""
    words = certificate.get("words", [])
    found: dict[frozenset[int], list[str]] = {}
    for entry in words if isinstance(words, list) else [words]:
        if (
            not isinstance(entry, list)
            or len(entry) != 3
            or not _integers(entry[:2])
            or not isinstance(entry[2], list)
        ):
            raise MapError(
                f"certificate: words: expected [step, step, [action, …]], got {brief(entry)}; "
                "write it with solve --json"
            )
        found[frozenset(entry[:2])] = entry[2]
    return found


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


def _not_apart(trace: Trace, i: int, j: int, word: Sequence[str]) -> str | None:
    """Say why a word does not show that two steps are at different dstates; None if it does."""
    for k, name in enumerate(word):
        for step in (i + k, j + k):
            action = trace.steps[step].action if step < len(trace) else None
            if action is None or action.name != name:
                return f"steps {i} and {j}: {brief(name)} is not what was done at step {step}"
    if not _look_different(trace.steps[i + len(word)], trace.steps[j + len(word)]):
        led = (
            "the same view"
            if trace.steps[i + len(word)].view == trace.steps[j + len(word)].view
            else "a view that is unknown"
        )
        return f"steps {i} and {j}: {' '.join(word) or 'nothing done'} leads to {led} from both"
    return None
