"""Write facts for `fast/names.lp`, and read its answers.

In that encoding, dstates have *names* (numbers) before the search. A *node* is a step. A *spare*
name belongs to no known step, and using it costs a dstate. The last spare name of a view is its
*rest*: one name for all dstates of the view that have no name of their own.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from functools import lru_cache
from itertools import pairwise

from clingo import Function, Model, Symbol

from ssh_abduction.solver.asp.facts.atoms import number_symbols


def name_facts(
    names: Iterable[tuple[int, int]],
    spares: Collection[Sequence[int]],
    links: Iterable[tuple[int, int, int]],
    choices: Sequence[Sequence[int]],
) -> str:
    """Return the facts that hold for all batches (a batch is the nodes of one call).

    `names` are pairs of a name and its view. `spares` has the spare names of each view; the last
    one is the rest. `links` are triples of a node, an action, and the node that it leads to.
    `choices` has the names that each node can have.
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
    return "\n".join(facts)


def batch_facts(
    batch: int,
    nodes: Iterable[tuple[int, int, Sequence[int], int | None]],
    links: Iterable[tuple[int, int, int]],
    apart: Iterable[tuple[int, int]],
    one: Iterable[tuple[int, int]],
) -> str:
    """Return the facts for one batch: the nodes of one call.

    Each node has its number, its view, the names that it can have, and the last node with this view
    that clingo has already (or None). `links` are triples of a node, an action, and the node that
    the action leads to. Nodes that are `apart` are different dstates, nodes of `one` are one.
    """
    facts = []
    for t, view, names, before in nodes:
        facts.append(f"node({batch},{t},{view}).")
        facts += [f"may_be({t},{name})." for name in names]
        facts += [f"follows({before},{t})."] if before is not None and len(names) > 1 else []
    facts += [f"link({batch},{t},{action},{u})." for t, action, u in links]
    facts += [f"apart({batch},{t},{u})." for t, u in apart]
    facts += [f"one({batch},{t},{u})." for t, u in one]
    return "\n".join(facts)


def resting(batch: int) -> Symbol:
    """Return the atom "a step up to this batch is at a rest" (dstates of a view without a name)."""
    return Function("resting", number_symbols(batch))


def read_names(model: Model) -> dict[int, int]:
    """Read an answer: a dict from the steps that clingo was given to their names."""
    return dict(map(_named, model.symbols(shown=True)))


@lru_cache(maxsize=2**16)
def _named(symbol: Symbol) -> tuple[int, int]:
    """Read a step and its name from an atom. This is cached, as answers share most atoms."""
    step, name = symbol.arguments
    return step.number, name.number


def not_together(number: int, pairs: Sequence[tuple[int, int]]) -> str:
    """Return rules against answers in which each pair is at one dstate that is not a rest."""
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
    """Return the rule that some links do not all hold while some steps have certain names."""
    body = [f"goes({s},{a},{x})" for s, a, x in links] + [f"is({t},{s})" for t, s in placed]
    return f":- {', '.join(body)}."
