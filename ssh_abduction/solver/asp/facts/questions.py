"""Rules for questions about known maps: other maps, maps of given size, forbidden equalities."""

from __future__ import annotations

from collections.abc import Iterable

from clingo import Function, Symbol

from ssh_abduction.solver.asp.facts.atoms import numbers
from ssh_abduction.solver.asp.facts.derivation_lp import active
from ssh_abduction.theory.evidence import Equality
from ssh_abduction.theory.fields import Count


def are_one(first: int, second: int) -> Symbol:
    """The atom of the readable encodings that two steps, the earlier one first, are one dstate."""
    return Function("same", numbers(first, second))


def forbidden_equalities(
    equalities: Iterable[Equality], where: Symbol | None = None, excusable: bool = False
) -> str:
    """The rule that these equalities of steps do not all hold.

    Args:
        equalities: The equalities.
        where: An atom; the rule holds only if the atom does. None for always.
        excusable: The rule does not hold where a displacement between the steps is ignored.
    """
    atoms = [str(where)] if where else []
    if excusable:
        atoms += [f"not jumped_since({e.first},{e.second})" for e in equalities]
    for e in equalities:
        sign, of = "" if e.holds else "not ", "same" if e.of == "dstate" else "same_place"
        atoms.append(f"{sign}{of}({min(e.first, e.second)},{max(e.first, e.second)})")
    return f":- {', '.join(atoms)}."


def rests_on(axiom: str, t: int, other: str) -> str:
    """The rule that if an axiom is active at step t, another one holds at every step."""
    return f":- {active(axiom, t)}, violation({other},T)."


def doubt(number: int, part: int, condition: str | None, *, one: bool) -> str:
    """The rules that make a doubt hold if it is open and two things are one, or are not.

    Args:
        number: The number of the doubt.
        part: The program part.
        condition: The condition that the two things are one; None if they never are.
        one: Whether the doubt is that they are one.
    """
    rules = [f"#external {open_doubt(number)}."]
    rules += (
        [f"one_in_doubt({number}) :- {condition}."]
        if condition
        else [f"#external one_in_doubt({number})."]
    )
    return "\n".join(
        [
            *rules,
            f"{some_doubt(part)} :- {open_doubt(number)}, "
            f"{'' if one else 'not '}one_in_doubt({number}).",
        ]
    )


def doubts_before(part: int) -> str:
    """The rule that some doubt holds if some doubt of an earlier part does."""
    return (
        f"{some_doubt(part)} :- {some_doubt(part - 1)}."
        if part > 1
        else f"#external {some_doubt(0)}."
    )


def steps_are_one(sort: str, i: int, j: int) -> str:
    """The condition that two steps, the earlier first, share a dstate, place, path or course.

    For a step and itself: the condition that it is along a path.
    """
    return {
        "dstates": f"same({i},{j})",
        "places": f"same_place({i},{j})",
        "paths": f"along({i},H,_), along({j},H,_)",
        "courses": f"same_course({i},{j})",
    }[sort]


def open_doubt(number: int) -> Symbol:
    """The external atom that a doubt is open."""
    return Function("open_doubt", numbers(number))


def some_doubt(part: int) -> Symbol:
    """The atom that some open doubt of this part of a program or of an earlier one holds."""
    return Function("some_doubt", numbers(part))


def exactly(number: int, count: Count) -> str:
    """The rule that a map has this many dstates, places or paths, while `of_number` is true."""
    counted = {
        "dstates": "T : is(T,T)",
        "places": "T : at(T,T)",
        "paths": "(T,H) : first_along(T,H)",
    }[count]
    atom = of_number(number, count)
    return f"#external {atom}.\n:- {atom}, #count {{ {counted} }} != {number}."


def of_number(number: int, count: Count) -> Symbol:
    """The external atom that fixes the number of dstates, places or paths of maps."""
    return Function("of_number", [Function(count), *numbers(number)])
