"""Ask for and read the conclusions of `derivation.lp`, from which explanations are made.

A conclusion is a statement about steps, such as that two steps are one dstate. The axioms imply it
if it holds in all maps.
"""

from __future__ import annotations

from collections.abc import Iterable

from clingo import Control, Function, Model, Symbol

from ssh_abduction.solver.asp.facts.atoms import number_symbols


def active(axiom: str, t: int) -> Symbol:
    """Return the atom that says that an axiom must hold at step t (explain.lp)."""
    return Function("active", [Function(axiom), *number_symbols(t)])


def told_of(steps: Iterable[int]) -> str:
    """Return the facts that name the steps that conclusions may be about."""
    return " ".join(f"told_of({t})." for t in sorted(set(steps)))


def conclusion(name: str, *steps: int) -> Symbol:
    """Return the atom of a conclusion, such as `one_dstate`, about some steps."""
    return Function("so", [Function(name, number_symbols(*steps))])


def read_conclusion(symbol: Symbol) -> tuple[str, tuple[int, ...]]:
    """Return the name and the steps of a conclusion, from its atom."""
    said = symbol.arguments[0]
    return said.name, tuple(argument.number for argument in said.arguments)


def conclusions_of(control: Control) -> list[Symbol]:
    """Return the atoms of all conclusions that are possible in a ground control."""
    return [atom.symbol for atom in control.symbolic_atoms.by_signature("so", 1)]


def read_argument(model: Model) -> tuple[frozenset[Symbol], frozenset[Symbol], frozenset[Symbol]]:
    """Read three sets of atoms from an answer in which axioms may be broken.

    The sets are the conclusions that hold; `active(N,T)` for each axiom N that is broken at step T;
    and `same(I,T)` for each pair of steps at one dstate.
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
    """Return the external atom that picks a conclusion for `some_fail`."""
    return Function("picked", [symbol])


def some_fail() -> Symbol:
    """Return the atom that holds if at least one of the picked conclusions does not hold."""
    return Function("some_fail")


def may_fail(conclusions: Iterable[Symbol]) -> str:
    """Return the rules that define `some_fail` and `picked` for some conclusions."""
    return "\n".join(
        f"#external {picked(c)}. {some_fail()} :- {picked(c)}, not {c}. "
        f"#heuristic {c} : {picked(c)}. [1,false]"
        for c in conclusions
    )
