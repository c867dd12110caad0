"""A loop that asks for an answer, checks it, forbids the reason if it is rejected, and asks again.

A rejected answer is not a map, and no map is forbidden along with it. So clingo solves a relaxation
of the problem at each turn. Its bounds hold, and the first accepted answer is as good as any map.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Hashable
from contextlib import closing
from typing import TypeVar

Answer = TypeVar("Answer")


def all_accepted(
    ask: Callable[[], Generator[Answer, None, object]],
    fits: Callable[[Answer], bool],
    forbid: Callable[[Answer], None],
    key: Callable[[Answer], Hashable],
    known: set[Hashable],
) -> Generator[Answer, None, None]:
    """Yield all answers that fit, each once. If one does not fit, forbid it, and ask again.

    `key` is equal for answers that are the same. Answers with `known` keys are left out, and the
    keys of accepted answers are added to them.
    """
    while True:
        refused: Answer | None = None
        with closing(ask()) as answers:
            for answer in answers:
                if key(answer) in known:
                    continue
                if not fits(answer):
                    refused = answer
                    break
                known.add(key(answer))
                yield answer
        if refused is None:
            return
        forbid(refused)
