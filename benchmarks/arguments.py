"""Arguments that several benchmarks have."""

from __future__ import annotations


def seeds_from(text: str) -> list[int]:
    """Parse a range of seeds such as 300-309, or a single seed.

    >>> seeds_from("300-302"), seeds_from("7")
    ([300, 301, 302], [7])
    """
    first, _, last = text.partition("-")
    return list(range(int(first), int(last or first) + 1))
