"""Write further rules for the readable encodings (`encodings/*.lp`) and for doubts.

They ask for maps that differ from known ones, ask for maps of a given size, and forbid equalities.
A *doubt* is a possibility: two things that are one in all known maps differ in an unknown one, or
the other way round.
"""

from __future__ import annotations

from collections.abc import Iterable

from clingo import Function, Symbol

from ssh_abduction.solver.asp.facts.atoms import number_symbols
from ssh_abduction.solver.asp.facts.derivation_lp import active
from ssh_abduction.theory.evidence import Equality
from ssh_abduction.theory.fields import Count


def are_one(first: int, second: int) -> Symbol:
    """Return the atom that says that two steps are one dstate. The first is the earlier step."""
    return Function("same", number_symbols(first, second))


def forbidden_equalities(equalities: Iterable[Equality], where: Symbol | None = None) -> str:
    """Return the rule that some equality of these does not hold. It may depend on atom `where`."""
    atoms = [str(where)] if where else []
    for e in equalities:
        if e.of == "displacement":
            atoms.append(f"not jumped({e.second})")
            continue
        sign, of = "" if e.holds else "not ", "same" if e.of == "dstate" else "same_place"
        atoms.append(f"{sign}{of}({min(e.first, e.second)},{max(e.first, e.second)})")
    return f":- {', '.join(atoms)}."


def rests_on(axiom: str, t: int, other: str) -> str:
    """Return the rule: if an axiom is active at step t, another axiom holds at every step."""
    return f":- {active(axiom, t)}, violation({other},T)."


def one_in_doubt(number: int, condition: str | None) -> str:
    """Return the rule that two things are one if a condition holds; never if it is None."""
    one = f"one_in_doubt({number})"
    return f"{one} :- {condition}." if condition else f"#external {one}."


def some_doubt(question: int, doubts: Iterable[tuple[int, bool]]) -> str:
    """Return the rule that some doubt holds while `asked(question)` is true.

    A doubt is the claim that two things, given by their numbers, are one (True) or are not.
    """
    none = ", ".join(f"{'not ' if one else ''}one_in_doubt({n})" for n, one in doubts)
    return f"#external {asked(question)}.\n:- {asked(question)}, {none}."


def asked(question: int) -> Symbol:
    """Return the external atom that is true while this question about doubts is asked."""
    return Function("asked", number_symbols(question))


def steps_are_one(sort: str, i: int, j: int) -> str:
    """Return the body of a rule that holds if two steps share a dstate, place, path or course.

    `sort` is "dstates", "places", "paths" or "courses", and step `i` the earlier one. For "paths"
    both may be one step: then the body holds if the step is along a path.
    """
    return {
        "dstates": f"same({i},{j})",
        "places": f"same_place({i},{j})",
        "paths": f"along({i},H,_), along({j},H,_)",
        "courses": f"same_course({i},{j})",
    }[sort]


def exactly(number: int, count: Count) -> str:
    """Return the rule that a map has this many dstates, places or paths, if `of_number` is true."""
    counted = {
        "dstates": "T : is(T,T)",
        "places": "T : at(T,T)",
        "paths": "(T,H) : first_along(T,H)",
    }[count]
    atom = of_number(number, count)
    return f"#external {atom}.\n:- {atom}, #count {{ {counted} }} != {number}."


def of_number(number: int, count: Count) -> Symbol:
    """Return the external atom that switches the rule of `exactly` on."""
    return Function("of_number", [Function(count), *number_symbols(number)])
