"""Write facts for `fast/faulty.lp`, and read its answers.

In that encoding views may be misread and actions may slip. It has several names (numbers of
possible dstates) for each view. The last name of a view is its *rest*: one name for all dstates of
the view that have no name of their own.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from itertools import groupby, pairwise
from operator import itemgetter

from clingo import Model

from ssh_abduction.solver.asp.facts.atoms import read_atom
from ssh_abduction.theory.evidence import Equality, Pairs


def faulty_names(names: Mapping[int, int]) -> Iterator[tuple[int, int]]:
    """Yield all names, each with its view. The last name of each view is its rest: it stands for
    all further dstates with that view.

    `names` has, for each view, the number of its names without the rest.
    """
    first = 0
    for view, count in names.items():
        yield from ((name, view) for name in range(first, first + count + 1))
        first += count + 1


def at_most_faults(most: int) -> str:
    """Return the rule that the steps given so far have at most this many faults."""
    return f":- #count {{ T,misread : misreads(T); T,slipped : slips(T) }} > {most}."


def dstates_and_faults_up_to(dstates: int, tenths: int) -> str:
    """Return rules that limit the number of dstates, and the cost of all faults in tenths."""
    faults = (
        "W,T,misread : misreads(T), price(misread,T,W); W,T,slipped : slips(T), price(slipped,T,W)"
    )
    return (
        f"#program more(b).\n:- #sum {{ {faults} }} > {tenths}.\n"
        f":- #count {{ S : used(S) }} > {dstates}."
    )


def faulty_base(actions: Iterable[int], names: Mapping[int, int], kinds: Iterable[str]) -> str:
    """Return the facts for the names of each view, the actions and the allowed kinds of faults."""
    found = [f"action({action})." for action in sorted(set(actions))]
    found += [f"allowed({kind})." for kind in kinds]
    for view, some in groupby(faulty_names(names), key=itemgetter(1)):
        of_view = [name for name, _ in some]
        found += [f"view({name},{view})." for name in of_view]
        found += [f"after({before},{name})." for before, name in pairwise(of_view)]
        found.append(f"rest({of_view[-1]}).")
    return "\n".join(found)


def faulty_batch(
    batch: int,
    seen: Sequence[int],
    actions: Sequence[int],
    steps: Sequence[int],
    known: Sequence[int],
    pairs: Pairs,
    price: Mapping[str, Sequence[int]],
    full: Collection[int] = (),
) -> str:
    """Return the facts for a batch: some further steps of a trace.

    `seen` has the view of each step, and `actions` the action after it, as numbers. `steps` are the
    steps of this batch, and `known` the steps of earlier batches, in the order in which clingo got
    them. `price` has, for each kind of fault, its cost at each step, in tenths of a dstate. At
    `full` steps an answer names the dstate even if they are misread.
    """
    given = {*known, *steps}
    new = set(steps)
    found = [f"node({batch},{t},{seen[t]})." for t in steps]
    found += [f"full({t})." for t in steps if t in full]
    found += [f"next({batch},{t},{u})." for t, u in pairwise([*known[-1:], *steps])]
    links = sorted({t for step in steps for t in (step - 1, step) if t in given and t + 1 in given})
    found += [f"link({batch},{t},{actions[t]},{t + 1})." for t in links]
    found += [
        f"price({kind},{t},{tenths[t]})."
        for kind, tenths in price.items()
        for t in (steps if kind == "misread" else links)
    ]
    for t in given:
        found += [
            f"excluded({batch},{i},{t})."
            for i in pairs.apart.get(t, ())
            if i in given and (i in new or t in new)
        ]
        found += [
            f"one({batch},{i},{t})."
            for i in pairs.one.get(t, ())
            if i in given and (i in new or t in new)
        ]
    return "\n".join(found)


def not_all_one(equalities: Collection[Equality]) -> str:
    """Return the rule that forbids maps in which all of these equalities of steps hold."""
    body = (f"is({e.first},S{k}), is({e.second},S{k})" for k, e in enumerate(equalities))
    return f":- {', '.join(body)}."


def read_faulty(model: Model) -> tuple[dict[int, int], frozenset[int], frozenset[int]]:
    """Read the dstate of each step, the slipped steps, and the misread steps without a dstate."""
    where: dict[int, int] = {}
    steps: dict[str, set[int]] = {"slips": set(), "lost": set()}
    for name, args in map(read_atom, model.symbols(shown=True)):
        if name == "is":
            where[args[0]] = args[1]
        else:
            steps[name].add(args[0])
    return where, frozenset(steps["slips"]), frozenset(steps["lost"])
