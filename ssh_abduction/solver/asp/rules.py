"""Checks whether clingo can read a user's own rules, and would ever ground them.

The errors say how to write them.

>>> from ssh_abduction import Theory
>>> from ssh_abduction.solver.asp.rules import check_rules
>>> from ssh_abduction.theory.rules import Rules
>>> rules = Rules("own.lp", "#program step(t). :- same(I,t), t > 9.")
>>> check_rules(Theory.causal().replace(rules=[rules]))
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from functools import lru_cache

import clingo
from clingo import ast

from ssh_abduction.data.errors import TheoryError
from ssh_abduction.theory import encodings
from ssh_abduction.theory.rules import Rules
from ssh_abduction.theory.theory import Theory

# The predicates of a trace's facts, which come step by step.
OF_STEPS = {"view", "act", "kind", "turns", "open", "excluded", "elsewhere", "one"}
READABLE = {"axiom", "path", "prefer", "defeasible"}  # the predicates of a theory's facts
# The program parts that are grounded, with the number of their parameters.
PARTS = {"base": 0, "step": 1, "check": 1}
TEXT = "<string>"  # what clingo calls a text that is no file
ALLOWED = {
    ast.ASTType.Rule,
    ast.ASTType.Program,
    ast.ASTType.Definition,
    ast.ASTType.Defined,
    ast.ASTType.Comment,
}
EXAMPLE = (
    "% @axiom(brief) No dstate is seen again later.\n#program step(t).\n"
    "violation(brief,t) :- same(I,t), t-I > 10."
)


def check_rules(theory: Theory) -> None:
    """Check the rules of a settled theory.

    Raises:
        TheoryError: Rules cannot be read, or would never be grounded.
    """
    for rules in theory.rules:
        others = tuple(other for other in theory.rules if other is not rules)
        _check(rules, others, encodings.needed_by(vars(theory)))
    if len(theory.rules) > 1:
        _check_safety(*theory.rules)  # together, as only one file may define a constant


@lru_cache(maxsize=64)
def _check(rules: Rules, others: tuple[Rules, ...], files: tuple[str, ...]) -> None:
    """Check a file of rules. It may use what the others and these encodings define."""
    of_steps, known, numbers = _predicates(files)
    statements = _statements(rules)
    own = {
        name
        for other in others
        for statement, _, _ in _statements(other)
        for name in _heads(statement)
    }
    own |= {name for statement, _, _ in statements for name in _heads(statement)}
    defined = {
        str(statement.name)
        for statement, _, _ in statements
        if statement.ast_type is ast.ASTType.Defined
    }
    named = {axiom.name for axiom in rules.axioms}
    for statement, part, parameter in statements:
        begin = statement.location.begin
        where = f"{rules.name}:{begin.line}"
        if begin.filename != TEXT:
            raise TheoryError(
                f"{rules.name}: expected rules, got #include of {begin.filename}; "
                "give that file, too (--rules may be given again)"
            )
        if statement.ast_type not in ALLOWED:
            raise TheoryError(
                f"{where}: expected rules, got {_short(statement)}; "
                "what is minimised and shown is chosen by the theory"
            )
        for function in _functions_of_python(statement):
            raise TheoryError(
                f"{where}: expected what clingo works out by itself, got {function}, "
                "a function of Python's; say it in rules"
            )
        if statement.ast_type is not ast.ASTType.Rule:
            continue
        for name in _heads(statement):
            if name in known - {"violation"}:
                raise TheoryError(
                    f"{where}: expected a rule that reads {name}, got one that defines it; "
                    "derive violation(name,t), or an atom of your own"
                )
        for atom in _derived(statement.head):
            if atom.name == "violation" and len(atom.arguments) not in numbers["violation"]:
                raise TheoryError(
                    f"{where}: {atom}: expected {_counted(numbers['violation'])}, "
                    f"got {len(atom.arguments)}; derive violation(name,t)"
                )
        for violated in _violations(statement):
            if violated not in named:
                raise TheoryError(
                    f"{where}: violation({violated},…): expected a sentence for it; "
                    f"write % @axiom({violated}) and what it says, on a line before"
                )
        for atom, positive in _atoms(statement):
            name = atom.name
            if name in of_steps and part == "base":
                raise TheoryError(
                    f"{where}: {name}: expected in a program part of steps, as what is in base is "
                    "read before there are steps; write #program step(t). before the rule"
                )
            if name not in known | own | defined | OF_STEPS | READABLE:
                raise TheoryError(
                    f"{where}: {name}: expected an atom that this theory has, got one that nothing "
                    f"defines; there are {', '.join(sorted(of_steps))}"
                )
            if name not in own | defined and len(atom.arguments) not in numbers.get(
                name, {len(atom.arguments)}
            ):
                raise TheoryError(
                    f"{where}: {atom}: expected {_counted(numbers[name])}, "
                    f"got {len(atom.arguments)}"
                )
            if (
                name in of_steps
                and not positive
                and part == "step"
                and atom.arguments
                and all(_is_settled(a, parameter) for a in atom.arguments)
            ):
                raise TheoryError(
                    f"{where}: not {atom}: expected to be asked at a step, got a question that is "
                    "asked before its steps are there; "
                    f"write {parameter} = {atom.arguments[-1]}, "
                    f"not {name}(…,{parameter}), in the body"
                )
    _check_safety(rules)


def read_by(rules: Rules, every: Iterable[Rules]) -> frozenset[str]:
    """The predicates that rules read and that none of these files defines.

    Args:
        rules: The rules, which passed `check_rules`.
        every: All files of rules.
    """
    own = {
        name
        for other in every
        for statement, _, _ in _statements(other)
        for name in _heads(statement)
    }
    of_rules = [
        statement
        for statement, _, _ in _statements(rules)
        if statement.ast_type is ast.ASTType.Rule
    ]
    return frozenset(
        atom.name for statement in of_rules for atom, _ in _atoms(statement) if atom.name not in own
    )


def _statements(rules: Rules) -> list[tuple[ast.AST, str, str]]:
    """The statements of rules, each with its program part and the parameter of the part.

    Raises:
        TheoryError: Clingo cannot read the rules, or a part is never grounded.
    """
    found: list[tuple[ast.AST, str, str]] = []
    messages: list[str] = []
    part, parameter = "base", ""

    def take(statement: ast.AST) -> None:
        nonlocal part, parameter
        if statement.ast_type is ast.ASTType.Program:
            part, parameter = (
                str(statement.name),
                ",".join(str(p.name) for p in statement.parameters),
            )
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
    # The first one opens base.
    return [entry for entry in found[1:] if entry[0].ast_type is not ast.ASTType.Comment]


def _said(rules: Rules, messages: list[str]) -> str:
    """Clingo's messages about rules, on one line."""
    said = " ".join(messages[0].split()) if messages else "clingo cannot read them"
    said = re.sub(r"^<[^>]*>", lambda _: rules.name, said)
    said = said if said.startswith(rules.name) else f"{rules.name}: {said}"
    return f"{said}; rules are written as in: {' '.join(EXAMPLE.splitlines())}"


def _check_safety(*files: Rules) -> None:
    """Let clingo look for unsafe variables, as it does before it grounds rules.

    Nothing is grounded, as that may take long.
    """
    messages: list[str] = []
    control = clingo.Control(logger=lambda _, message: messages.append(message))
    try:
        for rules in files:
            control.add("base", [], rules.text)
        control.ground([])
    except RuntimeError:
        raise TheoryError(
            _said(files[-1], [m for m in messages if "error" in m] or messages)
        ) from None


@lru_cache(maxsize=8)
def _predicates(
    files: tuple[str, ...],
) -> tuple[frozenset[str], frozenset[str], dict[str, frozenset[int]]]:
    """The predicates of these encodings.

    Returns:
        The predicates about steps, all predicates that the encodings define, and the possible
        numbers of arguments of each that they define or read.
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
    """The predicates that a rule derives, or lets clingo choose."""
    if statement.ast_type is ast.ASTType.Rule:
        yield from (atom.name for atom in _derived(statement.head))
    elif statement.ast_type is ast.ASTType.External:
        yield from (atom.name for atom, _ in _atoms_in(statement.atom))


def _violations(statement: ast.AST) -> Iterator[str]:
    """The axioms of which a rule derives violations."""
    for atom in _derived(statement.head):
        if (
            atom.name == "violation"
            and atom.arguments
            and atom.arguments[0].ast_type is ast.ASTType.SymbolicTerm
        ):
            yield str(atom.arguments[0])


def _derived(head: ast.AST) -> Iterator[ast.AST]:
    """The atoms of a head, without those of its conditions."""
    if head.ast_type is ast.ASTType.ConditionalLiteral:
        yield from (atom for atom, _ in _atoms_in(head.literal))
    elif head.ast_type is ast.ASTType.Literal:
        yield from (atom for atom, _ in _atoms_in(head))
    else:
        yield from (atom for child in _children(head) for atom in _derived(child))


def _atoms(statement: ast.AST) -> Iterator[tuple[ast.AST, bool]]:
    """The atoms in a rule's body and in the conditions of its head.

    Each comes with whether the rule reads that it holds.
    """
    derived = list(_derived(statement.head))
    for literal in statement.body:
        yield from _atoms_in(literal)
    yield from (
        (atom, positive)
        for atom, positive in _atoms_in(statement.head)
        if not any(atom is other for other in derived)
    )


def _atoms_in(node: ast.AST, positive: bool = True) -> Iterator[tuple[ast.AST, bool]]:
    """All atoms below a node, and whether no `not` stands before them."""
    if node.ast_type is ast.ASTType.SymbolicAtom:
        term = node.symbol
        while term.ast_type is ast.ASTType.UnaryOperation:  # classical negation
            term = term.argument
        if term.ast_type is ast.ASTType.Function:
            yield term, positive
        return
    negated = node.ast_type is ast.ASTType.Literal and node.sign != ast.Sign.NoSign
    for child in _children(node):
        yield from _atoms_in(child, positive and not negated)


def _children(node: ast.AST) -> Iterator[ast.AST]:
    for key in node.child_keys:
        child = getattr(node, key)
        yield from (
            [child]
            if isinstance(child, ast.AST)
            else [part for part in child or () if isinstance(part, ast.AST)]
        )


def _functions_of_python(node: ast.AST) -> Iterator[ast.AST]:
    """All terms below a node that call Python functions."""
    if node.ast_type is ast.ASTType.Function and node.external:
        yield node
    for child in _children(node):
        yield from _functions_of_python(child)


def _counted(numbers: frozenset[int]) -> str:
    return f"{' or '.join(map(str, sorted(numbers)))} arguments"


def _is_settled(term: ast.AST, parameter: str) -> bool:
    """Whether a term has neither a variable nor the parameter of its program part."""
    if term.ast_type is ast.ASTType.Variable or str(term) == parameter:
        return False
    return all(_is_settled(child, parameter) for child in _children(term))


def _short(statement: ast.AST) -> str:
    text = " ".join(str(statement).split())
    return text if len(text) <= 60 else f"{text[:57]}…"
