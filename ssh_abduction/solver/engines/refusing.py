"""The loop that asks for an answer, rejects it for a reason, forbids that, and asks again.

Forbidding a reason removes only answers that are no maps. So clingo solves a relaxation until it
rejects nothing, its bounds hold, and the first accepted answer is as good as any map.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Hashable
from contextlib import closing
from typing import TypeVar

Answer = TypeVar("Answer")
Reason = TypeVar("Reason")
Meanwhile = TypeVar("Meanwhile")
Member = TypeVar("Member")


def first_accepted(
    ask: Callable[[], Answer | None],
    refuse: Callable[[Answer], Reason | None],
    forbid: Callable[[Reason], None],
) -> Answer | None:
    """The first answer that is not rejected; None if there is no answer left.

    Args:
        ask: Gives the next answer by what is forbidden so far; None if there is none.
        refuse: Why an answer is rejected; None if it is accepted.
        forbid: Keeps answers from being given again for this reason.
    """
    while (answer := ask()) is not None:
        reason = refuse(answer)
        if reason is None:
            return answer
        forbid(reason)
    return None


def first_accepted_of(
    ask: Callable[[], Generator[Meanwhile, None, Answer | None]],
    refuse: Callable[[Answer], Reason | None],
    forbid: Callable[[Reason], None],
) -> Generator[Meanwhile, None, Answer | None]:
    """As `first_accepted`, for an `ask` that takes long.

    Yields what `ask` yields meanwhile. The answer is what `ask` returns.
    """
    while (answer := (yield from ask())) is not None:
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
    """All accepted answers, each once.

    Args:
        ask: Lists the answers by what is forbidden so far.
        refuse: Why an answer is rejected; None if it is accepted.
        forbid: Keeps answers from being given again for this reason.
        key: Equal for answers that are the same.
        known: The keys of answers to leave out. Those of accepted answers are added.
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


def smaller(
    members: list[Member],
    shrunk: Callable[[list[Member]], list[Member] | None],
    tries: int | None = None,
) -> list[Member]:
    """A small subset of members that still has a property of all of them.

    Leave out parts, half of the members first, single ones last.

    Args:
        members: They have the property together.
        shrunk: Given members, returns a subset with the property; None if they lack it.
        tries: Give up after this many failed tries; None for never.
    """
    size, failed = len(members), 0
    while size := size // 2:
        start = 0
        while start < len(members) and len(members) > 1:
            fewer = shrunk(members[:start] + members[start + size :])
            if fewer is not None:
                members = fewer
                continue
            start += size
            failed += 1
            if failed == tries:
                return members
    return members
