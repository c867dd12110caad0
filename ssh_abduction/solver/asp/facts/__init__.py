"""Turn a trace into facts for clingo, and an answer set of clingo into a map.

Only this package knows the names of predicates. Each family of encodings has a module here. Other
packages import the functions for the readable encodings (`encodings/*.lp`), which are listed below.

The fast encodings (`encodings/fast/*.lp`) have a step as an argument of a fact. So one call grounds
the rules for many steps. The readable encodings have a program part for each step. Grounding them
takes about thirty times as long, but mostly they are grounded only for short prefixes of a trace.
"""

from ssh_abduction.solver.asp.facts.answer_maps import read_map, read_steps
from ssh_abduction.solver.asp.facts.atoms import number_symbols
from ssh_abduction.solver.asp.facts.derivation_lp import (
    active,
    conclusion,
    conclusions_of,
    may_fail,
    picked,
    read_argument,
    read_conclusion,
    some_fail,
    told_of,
)
from ssh_abduction.solver.asp.facts.further_rules import are_one, forbidden_equalities, rests_on
from ssh_abduction.solver.asp.facts.readable import (
    encoding_names,
    most_paths,
    own_rules,
    program,
    query,
    run_by_steps,
    theory_facts,
    trace_facts,
)

__all__ = [
    "active",
    "are_one",
    "conclusion",
    "conclusions_of",
    "encoding_names",
    "forbidden_equalities",
    "may_fail",
    "most_paths",
    "number_symbols",
    "own_rules",
    "picked",
    "program",
    "query",
    "read_argument",
    "read_conclusion",
    "read_map",
    "read_steps",
    "rests_on",
    "run_by_steps",
    "some_fail",
    "theory_facts",
    "told_of",
    "trace_facts",
]
