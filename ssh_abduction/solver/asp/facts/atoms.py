"""Turn numbers, constants and atoms from Python to clingo, and back."""

from __future__ import annotations

from functools import cache, lru_cache

from clingo import Number, String, Symbol, SymbolType

COURSE = {"pos": 1, "neg": -1}


def constant(value: str | int) -> str:
    """Return a number or a text as a constant of clingo."""
    return str(Number(value) if isinstance(value, int) else String(value))


@lru_cache(maxsize=2**14)
def read_atom(symbol: Symbol) -> tuple[str, tuple[int, ...]]:
    """Return the name of an atom and its arguments as numbers; pos is 1 and neg is -1."""
    return symbol.name, tuple(
        arg.number if arg.type is SymbolType.Number else COURSE[arg.name]
        for arg in symbol.arguments
    )


_number = cache(Number)  # takes half the time of making a new number


def number_symbols(*arguments: int) -> list[Symbol]:
    """Return numbers as clingo's symbols, for the arguments of a program part or of an atom."""
    return [_number(argument) for argument in arguments]
