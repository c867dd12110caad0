"""A loop that asks for an answer, checks it, forbids the reason if it is rejected, and asks again.

A rejected answer is not a map, and no map is forbidden along with it. So clingo solves a relaxation
of the problem at each turn. Its bounds hold, and the first accepted answer is as good as any map.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Hashable
from contextlib import closing
from typing import TypeVar

Answer = TypeVar("Answer")
Reason = TypeVar("Reason")


def first_accepted(
    ask: Callable[[], Answer | None],
    refuse: Callable[[Answer], Reason | None],
    forbid: Callable[[Reason], None],
) -> Answer | None:
    """Ask for answers until one is accepted; None if there is no answer left.

    `refuse` returns a reason to reject an answer, or None. `forbid` forbids all answers to which
    this reason applies.
    """
    while (answer := ask()) is not None:
        reason = refuse(answer)
        if reason is None:
            return answer
        forbid(reason)
    return None


def all_accepted(
    ask: Callable[[], Generator[Answer, None, object]],
    refuse: Callable[[Answer], Reason | None],
    forbid: Callable[[Reason], None],
    key: Callable[[Answer], Hashable],
    known: set[Hashable],
) -> Generator[Answer, None, None]:
    """Yield all accepted answers, each once. See `first_accepted` for `refuse` and `forbid`.

    `key` is equal for answers that are the same. Answers with `known` keys are left out, and the
    keys of accepted answers are added to them.
    """
    while True:
        reason: Reason | None = None
        with closing(ask()) as answers:
            for answer in answers:
                if key(answer) in known:
                    continue
                reason = refuse(answer)
                if reason is not None:
                    break
                known.add(key(answer))
                yield answer
        if reason is None:
            return
        forbid(reason)
