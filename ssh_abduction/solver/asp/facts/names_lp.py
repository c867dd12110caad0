"""Facts for `fast/names.lp`, which gives dstates names before the search, and its answers."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from functools import lru_cache
from itertools import pairwise

from clingo import Function, Model, Symbol

from ssh_abduction.solver.asp.facts.atoms import numbers


def name_facts(
    names: Iterable[tuple[int, int]],
    spares: Collection[Sequence[int]],
    links: Iterable[tuple[int, int, int]],
    choices: Sequence[Sequence[int]],
    ordered: bool = True,
) -> str:
    """The facts of names.lp that hold for all batches.

    Args:
        names: Each name with its view.
        spares: For each view its spare names; the last one is the rest.
        links: Links of the nodes, with their actions.
        choices: For each node, the names that it can have.
        ordered: Whether spare names are used in the order of nodes. If not, a question may
            assume so.
    """
    view_of = dict(names)
    rests = {spare[-1] for spare in spares}
    leads = {
        (s, action, x)
        for t, action, u in links
        for s in choices[t]
        if s not in rests
        for x in choices[u]
    }
    facts = [f"view({name},{view})." for name, view in view_of.items()]
    for spare in spares:
        facts += (
            [f"spare({name})." for name in spare]
            + [f"after({r},{s})." for r, s in pairwise(spare)]
            + [f"rest({spare[-1]})."]
        )
    facts += [f"leads({s},{action},{x})." for s, action, x in leads]
    facts += [
        f"shows({s},{action},{view})."
        for s, action, view in {(s, action, view_of[x]) for s, action, x in leads}
    ]
    facts += ["ordered." if ordered else "{ ordered }."]
    return "\n".join(facts)


def batch_facts(
    batch: int,
    nodes: Iterable[tuple[int, int, Sequence[int], int | None]],
    links: Iterable[tuple[int, int, int]],
    apart: Iterable[tuple[int, int]],
) -> str:
    """The facts of names.lp for one batch.

    Args:
        batch: The number of the batch.
        nodes: Each node with its view, the names that it can have, and the node of that view
            that was given before it.
        links: Links with their actions.
        apart: Pairs of nodes that are not one dstate.
    """
    facts = []
    for t, view, names, before in nodes:
        facts.append(f"node({batch},{t},{view}).")
        facts += [f"may_be({t},{name})." for name in names]
        facts += [f"follows({before},{t})."] if before is not None and len(names) > 1 else []
    facts += [f"link({batch},{t},{action},{u})." for t, action, u in links]
    facts += [f"apart({batch},{t},{u})." for t, u in apart]
    return "\n".join(facts)


def resting(batch: int) -> Symbol:
    """The atom that some step of the batches up to this one is at the rest of its view."""
    return Function("resting", numbers(batch))


def ordered() -> Symbol:
    """The atom that steps are at spare names in the order of the names."""
    return Function("ordered")


def named(t: int, name: int) -> Symbol:
    """The atom that step t is at the dstate of that name."""
    return Function("is", numbers(t, name))


def used(name: int) -> Symbol:
    """The atom that a spare name is used."""
    return Function("used", numbers(name))


def read_names(model: Model) -> dict[int, int]:
    """The name of each step that an answer set of names.lp speaks of."""
    return dict(map(_named, model.symbols(shown=True)))


@lru_cache(maxsize=2**16)
def _named(symbol: Symbol) -> tuple[int, int]:
    """A step and its name.

    Results are cached, as successive answers share most atoms.
    """
    step, name = symbol.arguments
    return step.number, name.number


class NameReader:
    """Reads answers of names.lp that was given all links of a trace.

    The name of each step follows from where actions lead, which takes fewer calls to clingo.
    `actions` has the action after each step but the last, as numbers. `choices` has the names
    that each step can have.
    """

    def __init__(self, actions: Sequence[int], choices: Sequence[Sequence[int]]) -> None:
        self._actions = actions
        self._choices = choices
        # Where an action at a name led in the last answer, and the literal that says so.
        self._last: dict[tuple[int, int], tuple[int, int]] = {}

    def read(self, model: Model) -> dict[int, int]:
        """The name of each step, in an answer that uses no rest."""
        atoms = model.context.symbolic_atoms
        leads: dict[tuple[int, int], int] = {}
        name = next(
            s
            for s in self._choices[0]
            if (atom := atoms[named(0, s)]) and model.is_true(atom.literal)
        )
        names = {0: name}
        for t, action in enumerate(self._actions, 1):
            key = name, action
            if key not in leads:
                there, literal = self._last.get(key, (-1, 0))
                if not literal or not model.is_true(literal):
                    asked = (
                        (x, atoms[Function("goes", numbers(*key, x))]) for x in self._choices[t]
                    )
                    there, literal = next(
                        (x, atom.literal)
                        for x, atom in asked
                        if atom and model.is_true(atom.literal)
                    )
                    self._last[key] = there, literal
                leads[key] = there
            names[t] = name = leads[key]
        return names


def not_together(number: int, pairs: Sequence[tuple[int, int]]) -> str:
    """The rule that these pairs of steps are not all one dstate, unless they are at a rest.

    Args:
        number: A new number for each such rule.
        pairs: Pairs of steps with names.
    """
    together = [
        f"together({number},{k}) :- is({i},S), is({j},S), not rest(S)."
        for k, (i, j) in enumerate(pairs)
    ]
    return "\n".join(
        [*together, f":- {', '.join(f'together({number},{k})' for k in range(len(pairs)))}."]
    )


def forbidden_links(
    links: Iterable[tuple[int, int, int]], placed: Iterable[tuple[int, int]] = ()
) -> str:
    """The rule that these links do not all hold while these steps are at these dstates."""
    body = [f"goes({s},{a},{x})" for s, a, x in links] + [f"is({t},{s})" for t, s in placed]
    return f":- {', '.join(body)}."
