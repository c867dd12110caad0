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
from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import suppress
from functools import lru_cache
from itertools import combinations
from typing import NamedTuple

from clingo import Function, ast

from ssh_abduction.data.errors import TheoryError
from ssh_abduction.data.groups import first_index_of, indices_of
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Trace
from ssh_abduction.runtime.clock import POLL, look_at_clock
from ssh_abduction.solver.asp import facts
from ssh_abduction.solver.asp.control import Control
from ssh_abduction.solver.asp.facts import number_symbols
from ssh_abduction.theory import encodings
from ssh_abduction.theory.encodings import Rules
from ssh_abduction.theory.settle import Problem
from ssh_abduction.theory.theory import Theory

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
# The predicates that rules may read if a map is to be checked: those of a map, and those of a trace
# and its theory.
SHOWN = {"is", "same", "at", "same_place", "along", "same_course", "on_some_path", "on", "before"}
SHOWN |= {"travel", "turn"}
OF_TRACE = {"view", "act", "kind", "turns", "open", "axiom", "path", "prefer", "query"}
FORBIDDEN = """
#program step(t).
:- violation(N,t), axiom(N).
#program check(t).
:- violation(N,t), axiom(N).
"""


class _Statement(NamedTuple):
    """A statement of rules.

    Attributes:
        tree: Its syntax tree.
        part: The name of its program part.
        parameter: The parameter of that part; "" for none.
        derived: The atoms that it derives, lets clingo choose, or declares as external.
        read: The other atoms, each with a flag: False if `not` stands before it.
    """

    tree: ast.AST
    part: str
    parameter: str
    derived: Sequence[ast.AST] = ()
    read: Sequence[tuple[ast.AST, bool]] = ()

    @property
    def heads(self) -> set[str]:
        """The names of the predicates of `derived`."""
        return {atom.name for atom in self.derived}


class _Predicates(NamedTuple):
    """The predicates of some encodings.

    Attributes:
        of_steps: The names of those about steps.
        defined: The names of all that the encodings define.
        numbers: For each that they define or read, its possible numbers of arguments.
    """

    of_steps: frozenset[str]
    defined: frozenset[str]
    numbers: dict[str, set[int]]

    def counted(self, name: str) -> str:
        """Say how many arguments a predicate may have, such as "2 or 3 arguments"."""
        return f"{' or '.join(map(str, sorted(self.numbers[name])))} arguments"


def check_rules(theory: Theory) -> None:
    """Check the user's own rules in a settled theory. Raises TheoryError if one is not allowed."""
    own = frozenset().union(*map(_derived_by, theory.rules))
    for rules in theory.rules:
        _check(rules, own, encodings.needed_by(vars(theory)))
    if len(theory.rules) > 1:
        _check_safety(*theory.rules)  # together, as only one file may define a constant


@lru_cache(maxsize=64)
def _check(rules: Rules, own: frozenset[str], files: tuple[str, ...]) -> None:
    """Check a file of rules. Raises TheoryError if a rule is not allowed.

    `own` has the predicates that the user's rules define.
    """
    predicates, axioms = _predicates(files), {axiom.name for axiom in rules.axioms}
    for statement in _statements(rules):
        tree, begin = statement.tree, statement.tree.location.begin
        where = f"{rules.name}:{begin.line}"
        if begin.filename != TEXT:
            raise TheoryError(
                f"{rules.name}: expected rules, got #include of {begin.filename}; "
                "give that file, too (--set rules=FILE may be given again)"
            )
        if tree.ast_type not in ALLOWED:
            raise TheoryError(
                f"{where}: expected rules, got {_short(tree)}; "
                "what is minimised and shown is chosen by the theory"
            )
        for node, *_ in _walk(tree):
            if node.ast_type is ast.ASTType.Function and node.external:
                raise TheoryError(
                    f"{where}: expected rules without functions of Python, got {node}; "
                    "write rules that derive its value"
                )
        _check_head(statement, where, predicates, axioms)
        _check_body(statement, where, predicates, own)
    _check_safety(rules)


def _check_head(
    statement: _Statement, where: str, predicates: _Predicates, axioms: Collection[str]
) -> None:
    """Check what a rule derives. Raises TheoryError if it is not allowed."""
    for atom in statement.derived:
        if atom.name in predicates.defined - {"violation"}:
            raise TheoryError(
                f"{where}: expected a rule that reads {atom.name}, got one that defines it; "
                "derive violation(name,t), or an atom of your own"
            )
        if atom.name != "violation":
            continue
        if len(atom.arguments) not in predicates.numbers["violation"]:
            raise TheoryError(
                f"{where}: {atom}: expected {predicates.counted('violation')}, "
                f"got {len(atom.arguments)}; derive violation(name,t)"
            )
        violated = atom.arguments[0]
        if violated.ast_type is ast.ASTType.SymbolicTerm and str(violated) not in axioms:
            raise TheoryError(
                f"{where}: violation({violated},…): expected a sentence for it; "
                f"write % @axiom({violated}) and what it says, on a line before"
            )


def _check_body(
    statement: _Statement, where: str, predicates: _Predicates, own: Collection[str]
) -> None:
    """Check the atoms that a rule reads. Raises TheoryError if one is not allowed."""
    of_steps, numbers, parameter = predicates.of_steps, predicates.numbers, statement.parameter
    for atom, positive in statement.read:
        name, count = atom.name, len(atom.arguments)
        if name in of_steps and statement.part == "base":
            raise TheoryError(
                f"{where}: {name}: expected this rule in a program part of steps, as the part base "
                "is grounded before there are steps; write #program step(t). before the rule"
            )
        if name not in {*predicates.defined, *own, *OF_STEPS, *READABLE}:
            raise TheoryError(
                f"{where}: {name}: expected an atom that this theory has, got one that nothing "
                f"defines; there are {', '.join(sorted(of_steps))}"
            )
        if name not in own and count not in numbers.get(name, {count}):
            raise TheoryError(
                f"{where}: {atom}: expected {predicates.counted(name)}, got {count}; write as many "
                "as expected"
            )
        of_later_steps = name in of_steps and not positive and statement.part == "step"
        if of_later_steps and atom.arguments and _is_settled(atom, parameter):
            raise TheoryError(
                f"{where}: not {atom}: expected an atom with {parameter} as its last step, got "
                "fixed steps, which clingo reads before it has them; write "
                f"{parameter} = {atom.arguments[-1]}, not {name}(…,{parameter}), in the body"
            )


def _derived_by(rules: Rules) -> set[str]:
    """Return the predicates (names) that a file of rules derives, or declares to be derived."""
    statements = _statements(rules)
    declared = {str(s.tree.name) for s in statements if s.tree.ast_type is ast.ASTType.Defined}
    return declared.union(*(statement.heads for statement in statements))


def _statements(rules: Rules) -> list[_Statement]:
    """Parse a file of rules.

    Raises TheoryError if clingo cannot read the rules, or a program part is never grounded.
    """
    found: list[_Statement] = []
    messages: list[str] = []
    part, parameter = "base", ""

    def take(tree: ast.AST) -> None:
        nonlocal part, parameter
        if tree.ast_type is ast.ASTType.Program:
            part = str(tree.name)
            parameter = ",".join(str(p.name) for p in tree.parameters)
            if PARTS.get(part) != len(tree.parameters):
                raise TheoryError(
                    f"{rules.name}:{tree.location.begin.line}: expected a program part base, "
                    f"step(t) or check(t), got {_short(tree)}; others are never grounded"
                )
        atoms = [
            (term, positive, derived)
            for node, positive, derived in _walk(tree)
            if node.ast_type is ast.ASTType.SymbolicAtom and (term := _term_of(node)) is not None
        ]
        derived = [term for term, _, derived in atoms if derived]
        read = [(term, positive) for term, positive, derived in atoms if not derived]
        found.append(_Statement(tree, part, parameter, derived, read))

    try:
        ast.parse_string(rules.text, take, logger=lambda _, message: messages.append(message))
    except RuntimeError:
        raise TheoryError(_said(rules, messages)) from None
    # Leave out the first statement, which opens the part base.
    return [entry for entry in found[1:] if entry.tree.ast_type is not ast.ASTType.Comment]


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
        errors = [message for message in messages if "error" in message]
        raise TheoryError(_said(files[-1], errors or messages)) from None


@lru_cache(maxsize=8)
def _predicates(files: tuple[str, ...]) -> _Predicates:
    """Find the predicates of some encodings."""
    of_steps, defined, numbers = set(OF_STEPS), set[str](), dict[str, set[int]]()
    for name in files:
        with open(encodings.path(name), encoding="utf-8") as file:
            for statement in _statements(Rules(name, file.read())):
                defined |= statement.heads
                of_steps |= statement.heads if statement.part != "base" else set()
                for atom in (*statement.derived, *(atom for atom, _ in statement.read)):
                    numbers.setdefault(atom.name, set()).add(len(atom.arguments))
    return _Predicates(frozenset(of_steps - {"violation"}), frozenset(defined), numbers)


def _walk(
    node: ast.AST, positive: bool = True, derived: bool = True
) -> Iterator[tuple[ast.AST, bool, bool]]:
    """Yield all nodes of a syntax tree, each with two flags.

    The first is False if `not` stands before the node. The second says whether the node is in the
    head of its statement, and not in a condition there.
    """
    yield node, positive, derived
    negated = node.ast_type is ast.ASTType.Literal and node.sign != ast.Sign.NoSign
    is_conditional = node.ast_type is ast.ASTType.ConditionalLiteral
    for key in node.child_keys:
        child = getattr(node, key)
        in_head = derived and key != "body" and not (is_conditional and key == "condition")
        for part in [child] if isinstance(child, ast.AST) else child or ():
            if isinstance(part, ast.AST):
                yield from _walk(part, positive and not negated, in_head)


def _term_of(atom: ast.AST) -> ast.AST | None:
    """Return the name and arguments of an atom without classical negation; None if it has none."""
    term = atom.symbol
    while term.ast_type is ast.ASTType.UnaryOperation:
        term = term.argument
    return term if term.ast_type is ast.ASTType.Function else None


def _is_settled(term: ast.AST, parameter: str) -> bool:
    """Whether a term contains neither a variable nor the parameter of its program part."""
    return not any(
        node.ast_type is ast.ASTType.Variable or str(node) == parameter for node, *_ in _walk(term)
    )


def _short(statement: ast.AST) -> str:
    """Return a statement as text of at most 60 characters."""
    text = " ".join(str(statement).split())
    return text if len(text) <= 60 else f"{text[:57]}…"


def can_be_asked(theory: Theory) -> bool:
    """Whether `keeps_own_rules` can check the rules of a theory in which no field is "auto".

    It can if the rules read only what a map and a trace show. Maps with partial orders of paths do
    not show all that rules may read.
    """
    statements = [statement for rules in theory.rules for statement in _statements(rules)]
    known = SHOWN.union(OF_TRACE, *(statement.heads for statement in statements))
    return not statements or (
        (theory.level == "causal" or theory.path_order == "total")
        and all(atom.name in known for statement in statements for atom, _ in statement.read)
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
    control.add("base", [], facts.theory_facts(theory, len(ssh_map.theory_paths)))
    control.add("base", [], facts.trace_facts(problem, 0, len(trace), evidence=False))
    control.add("base", [], "\n".join(f"{fact}." for fact in _shown(trace, ssh_map)))
    control.add("base", [], f"query({len(trace) - 1}).\n{FORBIDDEN}")
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


def never_true(problem: Problem) -> Iterator[str]:
    """Yield a warning for each atom in a user's rules that no fact of the trace matches.

    A rule with such an atom has no effect. Facts of a trace are known before the search, so clingo
    only has to ground a rule with this atom alone. The parameter of a part stands for any step.
    """
    trace, theory = problem.trace, problem.theory
    if not theory.rules:
        return
    control = Control(check=look_at_clock, logger=lambda *_: None)
    control.add("base", [], facts.trace_facts(problem, 0, len(trace)))
    control.ground([("base", [])])
    for rules in theory.rules:
        for statement in _statements(rules):
            for atom in (atom for atom, positive in statement.read if positive):
                if atom.name not in OF_TRACE - READABLE - {"query"}:
                    continue
                some_step = rf"\b{statement.parameter}\b" if statement.parameter else "(?!)"
                alone, line = re.sub(some_step, "Step__", str(atom)), atom.location.begin.line
                name = f"holds_{len(rules.name)}_{line}_{atom.location.begin.column}"
                with suppress(RuntimeError):  # clingo cannot bind a step that is computed
                    control.add(name, [], f"{name} :- {alone}.")
                    control.ground([(name, [])])
                    if control.symbolic_atoms[Function(name)] is None:
                        hint = _as_text(atom, trace)
                        yield f"{rules.name}:{line}: {atom} holds at no step of this trace{hint}"


def _as_text(atom: ast.AST, trace: Trace) -> str:
    """Make a hint if a constant in an atom is a view or an action of the trace without quotes."""
    given = {str(part) for part in atom.arguments}
    names = {*map(str, trace.views), *(action.name for action in trace.actions)}
    some = next((f'; write "{name}" in quotes' for name in sorted(given & names)), "")
    return f", so its rule has no effect{some}"


def _shown(trace: Trace, ssh_map: SSHMap) -> Iterator[str]:
    """Yield the atoms that describe a map. The first step at a dstate or place is its name."""
    at = [ssh_map.dstates[label] for label in ssh_map.dstate_at]
    places = [s.place for s in at]
    courses = [None if s.path is None else (s.path, s.direction) for s in at]
    first, place = first_index_of(ssh_map.dstate_at), first_index_of(places)
    # For each path, its number, and the direction that the first step along it faces.
    path: dict[int, tuple[int, int]] = {}
    for t, s in enumerate(at):
        yield f"is({t},{first[s.id]})"
        if s.place is not None:
            yield f"at({t},{place[s.place]})"
        if s.path is not None and s.direction is not None:
            number, faced = path.setdefault(s.path, (len(path) + 1, s.direction))
            yield f"along({t},{number},{'pos' if s.direction == faced else 'neg'})"
            yield f"on_some_path({t})"
    of_steps: Iterable[tuple[str, Sequence[object]]] = (
        ("same", ssh_map.dstate_at),
        ("same_place", places),
        ("same_course", courses),
    )
    for name, things in of_steps:
        for thing, steps in indices_of(things).items():
            pairs = combinations(steps, 2) if thing is not None else ()
            yield from (f"{name}({i},{t})" for i, t in pairs)
    for h in ssh_map.theory_paths:
        number, faced = path[h.id]
        order = [place[p] for p in h.order[::faced]]
        yield from (f"on({number},{p})" for p in order)
        yield from (f"before({number},{p},{q})" for p, q in combinations(order, 2))
    slipped = {fault.step for fault in ssh_map.faults if fault.kind == "slipped"}
    for t, action in enumerate(trace.actions):
        if action.slipped or t in slipped:
            continue
        if action.kind == "travel":
            yield f"travel({t})"
        elif action.turn is not None:
            yield f"turn({t},{action.turn})"
