"""Conclusions of `derivation.lp`, for explanations: how to ask for them, and how to read them."""

from __future__ import annotations

from collections.abc import Iterable

from clingo import Control, Function, Model, Symbol

from ssh_abduction.solver.asp.facts.atoms import numbers


def active(axiom: str, t: int) -> Symbol:
    """The atom of an explanation that makes an axiom hold at step t."""
    return Function("active", [Function(axiom), *numbers(t)])


def told_of(steps: Iterable[int]) -> str:
    """The steps that conclusions are about (derivation.lp), as facts."""
    return " ".join(f"told_of({t})." for t in sorted(set(steps)))


def conclusion(name: str, *steps: int) -> Symbol:
    """A conclusion of derivation.lp."""
    return Function("so", [Function(name, numbers(*steps))])


def read_conclusion(symbol: Symbol) -> tuple[str, tuple[int, ...]]:
    """The name of a conclusion, and its steps."""
    said = symbol.arguments[0]
    return said.name, tuple(argument.number for argument in said.arguments)


def conclusions_of(control: Control) -> list[Symbol]:
    """All conclusions that an answer may have."""
    return [atom.symbol for atom in control.symbolic_atoms.by_signature("so", 1)]


def read_argument(model: Model) -> tuple[frozenset[Symbol], frozenset[Symbol], frozenset[Symbol]]:
    """Read an answer of an explanation.

    Returns:
        The conclusions that hold, the `active` atoms of the broken axioms, and the atoms of
        steps that are one dstate.
    """
    conclusions, broken, one = set[Symbol](), set[Symbol](), set[Symbol]()
    for symbol in model.symbols(atoms=True):
        if symbol.name == "so":
            conclusions.add(symbol)
        elif symbol.name == "violation":
            broken.add(Function("active", symbol.arguments))
        elif symbol.name == "same":
            one.add(symbol)
    return frozenset(conclusions), frozenset(broken), frozenset(one)


def picked(symbol: Symbol) -> Symbol:
    """The external atom that picks a conclusion; some picked one is to fail."""
    return Function("picked", [symbol])


def some_fail() -> Symbol:
    """The atom that some picked conclusion does not hold."""
    return Function("some_fail")


def may_fail(conclusions: Iterable[Symbol]) -> str:
    """The rules that let these conclusions fail."""
    return "\n".join(
        f"#external {picked(c)}. {some_fail()} :- {picked(c)}, not {c}. "
        f"#heuristic {c} : {picked(c)}. [1,false]"
        for c in conclusions
    )
