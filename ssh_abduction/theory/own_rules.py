"""Check a user's own rules: clingo has to be able to read them, and they may only forbid maps.

Errors say how to write the rules. `solver/asp/kept_rules.py` grounds them, and checks maps.

>>> from ssh_abduction import Theory
>>> from ssh_abduction.theory.encodings import Rules
>>> from ssh_abduction.theory.own_rules import check_statements
>>> rules = Rules("own.lp", "#program step(t). :- same(I,t), t-I > 1.")
>>> check_statements(Theory.causal().replace(rules=rules))
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Sequence
from functools import lru_cache
from typing import NamedTuple

from clingo import ast

from ssh_abduction.data.errors import TheoryError
from ssh_abduction.theory import encodings
from ssh_abduction.theory.encodings import Rules
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


class Statement(NamedTuple):
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


def check_statements(theory: Theory) -> None:
    """Check the user's own rules in a settled theory. Raises TheoryError if one is not allowed."""
    own = frozenset().union(*map(_derived_by, theory.rules))
    for rules in theory.rules:
        _check(rules, own, encodings.needed_by(vars(theory)))


@lru_cache(maxsize=64)
def _check(rules: Rules, own: frozenset[str], files: tuple[str, ...]) -> None:
    """Check a file of rules. Raises TheoryError if a rule is not allowed.

    `own` has the predicates that the user's rules define.
    """
    predicates, axioms = _predicates(files), {axiom.name for axiom in rules.axioms}
    for statement in statements(rules):
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


def _check_head(
    statement: Statement, where: str, predicates: _Predicates, axioms: Collection[str]
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
    statement: Statement, where: str, predicates: _Predicates, own: Collection[str]
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
    every = statements(rules)
    declared = {str(s.tree.name) for s in every if s.tree.ast_type is ast.ASTType.Defined}
    return declared.union(*(statement.heads for statement in every))


def statements(rules: Rules) -> list[Statement]:
    """Parse a file of rules.

    Raises TheoryError if clingo cannot read the rules, or a program part is never grounded.
    """
    found: list[Statement] = []
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
        found.append(Statement(tree, part, parameter, derived, read))

    try:
        ast.parse_string(rules.text, take, logger=lambda _, message: messages.append(message))
    except RuntimeError:
        raise TheoryError(clingo_said(rules, messages)) from None
    # Leave out the first statement, which opens the part base.
    return [entry for entry in found[1:] if entry.tree.ast_type is not ast.ASTType.Comment]


def clingo_said(rules: Rules, messages: list[str]) -> str:
    """Return an error message: what clingo says about rules, and an example, on one line."""
    said = " ".join(messages[0].split()) if messages else "clingo cannot read them"
    said = re.sub(r"^<[^>]*>", lambda _: rules.name, said)
    said = said if said.startswith(rules.name) else f"{rules.name}: {said}"
    return f"{said}; rules are written as in: {' '.join(EXAMPLE.splitlines())}"


@lru_cache(maxsize=8)
def _predicates(files: tuple[str, ...]) -> _Predicates:
    """Find the predicates of some encodings."""
    of_steps, defined, numbers = set(OF_STEPS), set[str](), dict[str, set[int]]()
    for name in files:
        with open(encodings.path(name), encoding="utf-8") as file:
            for statement in statements(Rules(name, file.read())):
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
