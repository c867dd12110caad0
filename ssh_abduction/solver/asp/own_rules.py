"""Check a user's own rules, and check whether a map obeys them.

First, clingo has to be able to read the rules, and it has to ground them. Errors say how to write
the rules.

The checker does not know such rules. So clingo checks a map: it grounds the rules with the content
of the map as facts. If the rules read only what a map shows, clingo has no choices except those in
the rules themselves. So the check takes hardly longer than grounding.

>>> from ssh_abduction import Theory, Trace, solve
>>> from ssh_abduction.solver.asp.own_rules import check_rules, keeps_own_rules
>>> from ssh_abduction.theory.settle import settle
>>> from ssh_abduction.theory.encodings import Rules
>>> trace = Trace.from_steps("aba", ["go", "go"])
>>> ssh_map = solve(trace, Theory.causal())[0]
>>> rules = [Rules("own.lp", f"#program step(t). :- same(I,t), t-I > {n}.") for n in (1, 2)]
>>> theories = [Theory.causal().replace(rules=rule) for rule in rules]
>>> [check_rules(theory) for theory in theories]
[None, None]
>>> [keeps_own_rules(settle(trace, theory), ssh_map) for theory in theories]
[False, True]
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Iterator
from functools import lru_cache
from typing import TypeAlias

from clingo import ast

from ssh_abduction.data.errors import TheoryError
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Trace
from ssh_abduction.runtime.clock import look_at_clock
from ssh_abduction.solver.asp import facts
from ssh_abduction.solver.asp.control import Control
from ssh_abduction.solver.asp.facts import number_symbols
from ssh_abduction.solver.asp.limits import POLL
from ssh_abduction.theory import encodings
from ssh_abduction.theory.encodings import Rules
from ssh_abduction.theory.settle import Problem
from ssh_abduction.theory.theory import Theory

# Of some encodings: the predicates about steps, all that they define, and the numbers of arguments.
_Predicates: TypeAlias = tuple[frozenset[str], frozenset[str], dict[str, frozenset[int]]]
# The predicates of the facts of a trace. These facts are added step by step.
OF_STEPS = {"view", "act", "kind", "turns", "open", "excluded", "elsewhere", "one", "together"}
READABLE = {"axiom", "path", "prefer", "defeasible"}  # the predicates of a theory's facts
# The program parts that are grounded, with the number of their parameters.
PARTS = {"base": 0, "step": 1, "check": 1}
TEXT = "<string>"  # clingo's name for a text that is not in a file
ALLOWED = {
    ast.ASTType.Rule,
    ast.ASTType.Program,
    ast.ASTType.Definition,
    ast.ASTType.Defined,
    ast.ASTType.Comment,
}
EXAMPLE = (
    "% @axiom(brief) No dstate is seen again after 10 steps.\n#program step(t).\n"
    "violation(brief,t) :- same(I,t), t-I > 10."
)


def check_rules(theory: Theory) -> None:
    """Check the user's own rules in a settled theory. Raises TheoryError if one is not allowed."""
    for rules in theory.rules:
        others = tuple(other for other in theory.rules if other is not rules)
        _check(rules, others, encodings.needed_by(vars(theory)))
    if len(theory.rules) > 1:
        _check_safety(*theory.rules)  # together, as only one file may define a constant


@lru_cache(maxsize=64)
def _check(rules: Rules, others: tuple[Rules, ...], files: tuple[str, ...]) -> None:
    """Check a file of rules. Raises TheoryError if a rule is not allowed."""
    predicates, statements = _predicates(files), _statements(rules)
    own = _derived_by((*others, rules)) | {
        str(statement.name)
        for statement, _, _ in statements
        if statement.ast_type is ast.ASTType.Defined
    }
    for statement, part, parameter in statements:
        begin = statement.location.begin
        where = f"{rules.name}:{begin.line}"
        if begin.filename != TEXT:
            raise TheoryError(
                f"{rules.name}: expected rules, got #include of {begin.filename}; "
                "give that file, too (--set rules=FILE may be given again)"
            )
        if statement.ast_type not in ALLOWED:
            raise TheoryError(
                f"{where}: expected rules, got {_short(statement)}; "
                "what is minimised and shown is chosen by the theory"
            )
        for node, _ in _walk(statement):
            if node.ast_type is ast.ASTType.Function and node.external:
                raise TheoryError(
                    f"{where}: expected rules without functions of Python, got {node}; "
                    "write rules that derive its value"
                )
        if statement.ast_type is ast.ASTType.Rule:
            _check_head(statement, where, predicates, {axiom.name for axiom in rules.axioms})
            _check_body((statement, part, parameter), where, predicates, own)
    _check_safety(rules)


def _check_head(
    rule: ast.AST, where: str, predicates: _Predicates, axioms: Collection[str]
) -> None:
    """Check what a rule derives. Raises TheoryError if it is not allowed."""
    _, known, numbers = predicates
    for name in _heads(rule):
        if name in known - {"violation"}:
            raise TheoryError(
                f"{where}: expected a rule that reads {name}, got one that defines it; "
                "derive violation(name,t), or an atom of your own"
            )
    violations = [atom for atom in _derived(rule.head) if atom.name == "violation"]
    for atom in violations:
        if len(atom.arguments) not in numbers["violation"]:
            raise TheoryError(
                f"{where}: {atom}: expected {_counted(numbers['violation'])}, "
                f"got {len(atom.arguments)}; derive violation(name,t)"
            )
    for violated in (atom.arguments[0] for atom in violations):
        is_name = violated.ast_type is ast.ASTType.SymbolicTerm
        if is_name and str(violated) not in axioms:
            raise TheoryError(
                f"{where}: violation({violated},…): expected a sentence for it; "
                f"write % @axiom({violated}) and what it says, on a line before"
            )


def _check_body(
    entry: tuple[ast.AST, str, str], where: str, predicates: _Predicates, own: Collection[str]
) -> None:
    """Check the atoms of a rule, from `_statements`. Raises TheoryError if one is not allowed.

    `own` has the predicates that the user's rules define.
    """
    (rule, part, parameter), (of_steps, known, numbers) = entry, predicates
    for atom, positive in _atoms(rule):
        name, count = atom.name, len(atom.arguments)
        if name in of_steps and part == "base":
            raise TheoryError(
                f"{where}: {name}: expected this rule in a program part of steps, as the part base "
                "is grounded before there are steps; write #program step(t). before the rule"
            )
        if name not in {*known, *own, *OF_STEPS, *READABLE}:
            raise TheoryError(
                f"{where}: {name}: expected an atom that this theory has, got one that nothing "
                f"defines; there are {', '.join(sorted(of_steps))}"
            )
        if name not in own and count not in numbers.get(name, {count}):
            raise TheoryError(
                f"{where}: {atom}: expected {_counted(numbers[name])}, got {count}; write as many "
                "as expected"
            )
        of_later_steps = name in of_steps and not positive and part == "step" and atom.arguments
        if of_later_steps and all(_is_settled(a, parameter) for a in atom.arguments):
            raise TheoryError(
                f"{where}: not {atom}: expected an atom with {parameter} as its last step, got "
                "fixed steps, which clingo reads before it has them; write "
                f"{parameter} = {atom.arguments[-1]}, not {name}(…,{parameter}), in the body"
            )


def _derived_by(every: Iterable[Rules]) -> set[str]:
    """Return the predicates (names) that files of rules derive."""
    return {name for rules in every for rule, _, _ in _statements(rules) for name in _heads(rule)}


def read_by(rules: Rules, every: Iterable[Rules]) -> frozenset[str]:
    """Return the predicates (names) that a file of rules reads but none of the files defines."""
    own = _derived_by(every)
    of_rules = [
        statement
        for statement, _, _ in _statements(rules)
        if statement.ast_type is ast.ASTType.Rule
    ]
    return frozenset(
        atom.name for statement in of_rules for atom, _ in _atoms(statement) if atom.name not in own
    )


def _statements(rules: Rules) -> list[tuple[ast.AST, str, str]]:
    """Parse a file of rules.

    Raises TheoryError if clingo cannot read the rules, or a program part is never grounded. Each
    statement comes with the name of its program part and the parameter of that part ("" for none).
    """
    found: list[tuple[ast.AST, str, str]] = []
    messages: list[str] = []
    part, parameter = "base", ""

    def take(statement: ast.AST) -> None:
        nonlocal part, parameter
        if statement.ast_type is ast.ASTType.Program:
            part = str(statement.name)
            parameter = ",".join(str(p.name) for p in statement.parameters)
            if PARTS.get(part) != len(statement.parameters):
                where = f"{rules.name}:{statement.location.begin.line}"
                raise TheoryError(
                    f"{where}: expected a program part base, step(t) or check(t), "
                    f"got {_short(statement)}; others are never grounded"
                )
        found.append((statement, part, parameter))

    try:
        ast.parse_string(rules.text, take, logger=lambda _, message: messages.append(message))
    except RuntimeError:
        raise TheoryError(_said(rules, messages)) from None
    # Leave out the first statement, which opens the part base.
    return [entry for entry in found[1:] if entry[0].ast_type is not ast.ASTType.Comment]


def _said(rules: Rules, messages: list[str]) -> str:
    """Return an error message: what clingo says about rules, and an example, on one line."""
    said = " ".join(messages[0].split()) if messages else "clingo cannot read them"
    said = re.sub(r"^<[^>]*>", lambda _: rules.name, said)
    said = said if said.startswith(rules.name) else f"{rules.name}: {said}"
    return f"{said}; rules are written as in: {' '.join(EXAMPLE.splitlines())}"


def _check_safety(*files: Rules) -> None:
    """Let clingo find unsafe variables, without grounding. Raises TheoryError if there are some."""
    messages: list[str] = []
    control = Control(logger=lambda _, message: messages.append(message))
    try:
        for rules in files:
            control.add("base", [], rules.text)
        control.ground([])
    except RuntimeError:
        raise TheoryError(
            _said(files[-1], [m for m in messages if "error" in m] or messages)
        ) from None


@lru_cache(maxsize=8)
def _predicates(files: tuple[str, ...]) -> _Predicates:
    """Find the predicates of some encodings.

    Returns the names of those about steps; the names of all that the encodings define; and for each
    that they define or read, its possible numbers of arguments.
    """
    of_steps = set(OF_STEPS)
    defined, numbers = set[str](), dict[str, set[int]]()
    for name in files:
        with open(encodings.path(name), encoding="utf-8") as file:
            for statement, part, _ in _statements(Rules(name, file.read())):
                heads = set(_heads(statement))
                defined |= heads
                of_steps |= heads if part != "base" else set()
                for atom, _ in _atoms_in(statement):
                    numbers.setdefault(atom.name, set()).add(len(atom.arguments))
    return (
        frozenset(of_steps - {"violation"}),
        frozenset(defined),
        {name: frozenset(found) for name, found in numbers.items()},
    )


def _heads(statement: ast.AST) -> Iterator[str]:
    """Yield the names of the predicates that a statement derives or lets clingo choose."""
    if statement.ast_type is ast.ASTType.Rule:
        yield from (atom.name for atom in _derived(statement.head))
    elif statement.ast_type is ast.ASTType.External:
        yield from (atom.name for atom, _ in _atoms_in(statement.atom))


def _derived(head: ast.AST) -> Iterator[ast.AST]:
    """Yield the atoms that the head of a rule derives, without the atoms of its conditions."""
    if head.ast_type is ast.ASTType.ConditionalLiteral:
        head = head.literal
    if head.ast_type is ast.ASTType.Literal:
        yield from (atom for atom, _ in _atoms_in(head))
    else:
        yield from (atom for child in _children(head) for atom in _derived(child))


def _atoms(statement: ast.AST) -> Iterator[tuple[ast.AST, bool]]:
    """Yield the atoms that a rule reads, each with a flag: False if `not` stands before it."""
    derived = list(_derived(statement.head))
    for literal in statement.body:
        yield from _atoms_in(literal)
    yield from (
        (atom, positive)
        for atom, positive in _atoms_in(statement.head)
        if not any(atom is other for other in derived)
    )


def _atoms_in(tree: ast.AST) -> Iterator[tuple[ast.AST, bool]]:
    """Yield all atoms in a syntax tree, each with a flag: False if `not` stands before it."""
    for node, positive in _walk(tree):
        if node.ast_type is ast.ASTType.SymbolicAtom:
            term = node.symbol
            while term.ast_type is ast.ASTType.UnaryOperation:  # classical negation
                term = term.argument
            if term.ast_type is ast.ASTType.Function:
                yield term, positive


def _walk(node: ast.AST, positive: bool = True) -> Iterator[tuple[ast.AST, bool]]:
    """Yield all nodes of a syntax tree, each with a flag: False if `not` stands before it."""
    yield node, positive
    negated = node.ast_type is ast.ASTType.Literal and node.sign != ast.Sign.NoSign
    for child in _children(node):
        yield from _walk(child, positive and not negated)


def _children(node: ast.AST) -> Iterator[ast.AST]:
    """Yield the children of a node of a syntax tree."""
    for key in node.child_keys:
        child = getattr(node, key)
        yield from (
            [child]
            if isinstance(child, ast.AST)
            else [part for part in child or () if isinstance(part, ast.AST)]
        )


def _counted(numbers: frozenset[int]) -> str:
    """Say how many arguments are possible, such as "2 or 3 arguments"."""
    return f"{' or '.join(map(str, sorted(numbers)))} arguments"


def _is_settled(term: ast.AST, parameter: str) -> bool:
    """Whether a term contains neither a variable nor the parameter of its program part."""
    return not any(
        node.ast_type is ast.ASTType.Variable or str(node) == parameter for node, _ in _walk(term)
    )


def _short(statement: ast.AST) -> str:
    """Return a statement as text of at most 60 characters."""
    text = " ".join(str(statement).split())
    return text if len(text) <= 60 else f"{text[:57]}…"


# The predicates that rules may read. SHOWN are those of a map, OF_TRACE those of a trace and its
# theory.
SHOWN = {"is", "same", "at", "same_place", "along", "same_course", "on_some_path", "on", "before"}
SHOWN |= {"travel", "turn"}
OF_TRACE = frozenset({"view", "act", "kind", "turns", "open", "axiom", "path", "prefer", "query"})
FRAME = """
#defined query/1. #defined violation/2. #defined is/2. #defined same/2. #defined at/2.
#defined same_place/2.
#defined along/3.
#defined same_course/2. #defined on_some_path/1. #defined on/2. #defined before/3.
#defined travel/1.
#defined turn/2. #defined kind/2. #defined turns/2. #defined open/2.
#defined act/2. #defined prefer/2. #defined path/1.
#program step(t).
:- violation(N,t), axiom(N).
#program check(t).
:- violation(N,t), axiom(N).
"""


def can_be_asked(theory: Theory) -> bool:
    """Whether `keeps_own_rules` can check the rules of a theory in which no field is "auto".

    It can if the rules read only what a map and a trace show. Maps with partial orders of paths do
    not show all that rules may read.
    """
    if not theory.rules:
        return True
    settled = theory.level == "causal" or theory.path_order == "total"
    return settled and all(
        read_by(rules, theory.rules) <= SHOWN | OF_TRACE for rules in theory.rules
    )


def keeps_own_rules(problem: Problem, ssh_map: SSHMap) -> bool:
    """Whether a map of all steps, which satisfies all other axioms, obeys the user's own rules.

    Call this only if `can_be_asked` is True.
    """
    trace, theory = problem.trace, problem.theory
    if not theory.rules:
        return True
    control = Control(check=look_at_clock)
    steps = range(len(trace))
    control.add("base", [], facts.theory_facts(theory, len(ssh_map.paths)))
    control.add("base", [], facts.trace_facts(problem, 0, len(trace), evidence=False))
    control.add("base", [], "\n".join(f"{fact}." for fact in _shown(trace, ssh_map)))
    control.add("base", [], f"query({len(trace) - 1}).\n{FRAME}")
    control.add("base", [], facts.own_rules(theory))
    control.ground([("base", [])])
    for t in steps:
        look_at_clock()
        control.ground([("step", number_symbols(t))])
    control.ground([("check", number_symbols(len(trace) - 1))])
    with control.searching() as handle:
        while not handle.wait(POLL):
            look_at_clock()
        return bool(handle.get().satisfiable)


def _shown(trace: Trace, ssh_map: SSHMap) -> Iterator[str]:
    """Yield the atoms that describe a map. The first step at a dstate or place is its name."""
    first: dict[int, int] = {}
    place: dict[int, int] = {}
    # For each path, its number, and the direction that the first step along it faces.
    path: dict[int, tuple[int, int]] = {}
    # The steps so far at each dstate, at each place, and along each course.
    before: dict[int, list[int]] = {}
    here: dict[int, list[int]] = {}
    along: dict[tuple[int, int], list[int]] = {}
    for t, label in enumerate(ssh_map.dstate_at):
        s = ssh_map.dstates[label]
        yield f"is({t},{first.setdefault(label, t)})"
        yield from (f"same({i},{t})" for i in before.setdefault(label, []))
        before[label].append(t)
        if s.place is not None:
            yield f"at({t},{place.setdefault(s.place, t)})"
            yield from (f"same_place({i},{t})" for i in here.setdefault(s.place, []))
            here[s.place].append(t)
        if s.path is not None and s.direction is not None:
            number, faced = path.setdefault(s.path, (len(path) + 1, s.direction))
            yield f"along({t},{number},{'pos' if s.direction == faced else 'neg'})"
            yield f"on_some_path({t})"
            yield from (
                f"same_course({i},{t})" for i in along.setdefault((s.path, s.direction), [])
            )
            along[s.path, s.direction].append(t)
    for h in ssh_map.paths:
        number, faced = path[h.id]
        order = [place[p] for p in h.order[::faced]]
        yield from (f"on({number},{p})" for p in order)
        yield from (
            f"before({number},{p},{q})" for i, p in enumerate(order) for q in order[i + 1 :]
        )
    slipped = {fault.step for fault in ssh_map.faults if fault.kind == "slipped"}
    for t, action in enumerate(trace.actions):
        if action.slipped or t in slipped:
            continue
        if action.kind == "travel":
            yield f"travel({t})"
        elif action.turn is not None:
            yield f"turn({t},{action.turn})"
