"""Arguments that several benchmarks have."""

from __future__ import annotations

import argparse


def seeds_from(text: str) -> list[int]:
    """Parse a range of seeds such as 300-309, or a single seed.

    >>> seeds_from("300-302"), seeds_from("7")
    ([300, 301, 302], [7])
    """
    first, _, last = text.partition("-")
    return list(range(int(first), int(last or first) + 1))


def add_number(
    parser: argparse.ArgumentParser, option: str, metavar: str, default: float, what: str
) -> None:
    """Add an option for a number. It has the type of its default, which the help names."""
    said = f"{what} (default {default:g})"
    parser.add_argument(option, type=type(default), default=default, metavar=metavar, help=said)


def add_pattern(parser: argparse.ArgumentParser, option: str, what: str) -> None:
    """Add an option for a regular expression, which chooses what to measure."""
    said = f"measure only {what} that match this regular expression"
    parser.add_argument(option, default="", metavar="PATTERN", help=said)
