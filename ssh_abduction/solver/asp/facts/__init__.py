"""Between Python and clingo: a trace becomes facts, and an answer set becomes a map.

No module outside this package knows the name of a predicate. Each family of encodings has a module
here. Other packages import the functions for the readable encodings, which are listed below.

In the fast encodings a step is an argument of a fact, so that one call grounds the rules for many
steps. A program part for each step would take about thirty times as long. Only the readable
encodings have such parts. They are mostly grounded for short prefixes.
"""

from ssh_abduction.solver.asp.facts.answer_maps import read_map, read_steps
from ssh_abduction.solver.asp.facts.atoms import numbers
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
from ssh_abduction.solver.asp.facts.questions import are_one, forbidden_equalities, rests_on
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
    "numbers",
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
