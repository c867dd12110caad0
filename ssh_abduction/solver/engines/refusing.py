"""The one loop for what is found out only of an answer: whoever refuses it says why, that is forbidden, and clingo is asked again.

What is forbidden takes away only answers that are no maps. So what clingo solves is a relaxation until nothing is refused, its bounds hold, and the
first answer that nothing refuses is as good as any.
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
    """The first answer that nothing refuses; None where there is no answer left.

    ask     gives the next answer, now that something is forbidden
    refuse  why an answer is none after all; None where it is one
    forbid  what lets answers not be given again for this reason
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
    """The same as `first_accepted`, where asking takes long: what is found meanwhile is yielded, and the answer is what `ask` returns."""
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
    """All answers that nothing refuses, each once. Parameters as in `first_accepted`, but for

    ask    lists the answers anew, now that something is forbidden
    key    what answers that are the same have in common
    known  the keys of answers that are not to be given
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
        shrunk: Of some members, a subset that has the property; None if they do not have it.
        tries: Give up after this many tries in vain; None for never.
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
