"""Why a trace has no map: the shortest stretch of it that has none, and a smallest set of axioms and steps that clash there.

>>> from ssh_abduction import Theory, Trace
>>> from ssh_abduction.explain.no_map import explain
>>> trace = Trace.from_steps(views=["a", "b", "c", "d"], actions=["travel", "around", "around"])
>>> explanation = explain(trace, Theory.topological())
>>> explanation.first, explanation.last, explanation.axioms[0]
(0, 3, 'functional_view')
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, TypeAlias

import clingo

from ssh_abduction.data.errors import TheoryError, TraceError, brief, is_whole
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Action, Step, Trace, checked_trace
from ssh_abduction.solver import check_rules, facts
from ssh_abduction.theory import encodings
from ssh_abduction.theory.evidence import Displacement, Equality, Planar, evidence_of
from ssh_abduction.theory.theory import ASSERTIONS, Theory, checked_theory

# Seconds between two questions whether to stop, while clingo is busy: as in asp/limits.py.
POLL = 0.05
# Steps that are grounded between two such questions: eight take a moment, and more calls would take longer.
AT_A_TIME = 8
# So many refused returns that end at one step are told of, at most.
MOST_SENTENCES = 3

Assumption: TypeAlias = tuple[clingo.Symbol, bool]  # an atom that is true, or is false
Refusal: TypeAlias = frozenset[Equality]  # what cannot all hold


@dataclass(frozen=True, slots=True)
class Clash:
    """An axiom that, together with the other clashes, cannot hold at all of these steps. Of the steps that an axiom is about at once, the last one is named."""

    axiom: str
    steps: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Explanation:
    """Steps `first` to `last` alone have no map. If any one clash is dropped, even at one of its steps only, they have one.

    sentences  what displacements say where they clash (`one_pose`): for each of these steps, at most three of the returns that end there, cannot be, and take part in
               the clash, the clearest first
    """

    first: int
    last: int
    clashes: tuple[Clash, ...]
    sentences: tuple[str, ...] = ()

    @property
    def axioms(self) -> tuple[str, ...]:
        """The names of the axioms that clash."""
        return tuple(clash.axiom for clash in self.clashes)

    def __str__(self) -> str:
        parts = [
            f"{c.axiom} ({'step' if len(c.steps) == 1 else 'steps'} {', '.join(map(str, c.steps))})"
            for c in self.clashes
        ]
        return f"no map satisfies the axioms: in steps {self.first} to {self.last} these clash: {', '.join(parts)}"

    def to_dict(self) -> dict[str, object]:
        return {
            "first": self.first,
            "last": self.last,
            "clashes": [{"axiom": c.axiom, "steps": list(c.steps)} for c in self.clashes],
            "sentences": list(self.sentences),
        }


class Interrupted(Exception):  # noqa: N818 - not an error
    """The caller's `stop` returned True."""


def explain(
    trace: Trace, theory: Theory | None = None, stop: Callable[[], bool] = lambda: False
) -> Explanation | None:
    """Why the trace has no map under a theory (default Theory.topological()), or None if it has one.

    The stretch is found by dropping steps from the end and then from the start, the clashes by dropping axioms one by one.

    stop  asked now and then; when it returns True, Interrupted is raised
    """
    theory = checked_theory(theory).resolve(checked_trace(trace))
    if theory.jumped:
        raise TheoryError(
            "jumped: expected displacements that hold where a trace is explained; leave it out (--jumped)"
        )
    theory.check_steps(trace)
    check_rules(theory)
    length = shortest(
        len(trace), lambda n: not Axioms(Piece.of(trace, theory, range(n)), stop).consistent()
    )
    if length is None:
        return None
    last = length - 1
    length = (
        shortest(
            length,
            lambda n: (
                not Axioms(
                    Piece.of(trace, theory, range(last + 1 - n, last + 1)), stop
                ).consistent()
            ),
        )
        or length
    )
    first = last + 1 - length
    clashes: dict[str, list[int]] = {}
    axioms = Axioms(Piece.of(trace, theory, range(first, last + 1)), stop, relaxed=True)
    clash = axioms.smallest_clash()
    for axiom, step in clash:
        clashes.setdefault(axiom, []).append(first + step)
    order = theory.axioms
    found = tuple(
        Clash(name, tuple(sorted(clashes[name]))) for name in sorted(clashes, key=order.index)
    )
    return Explanation(first, last, found, axioms.sentences(clash))


def why_apart(trace: Trace, first: int, second: int, theory: Theory | None = None) -> str | None:
    """Why displacements keep two steps from being at one place, or one dstate, in a sentence; None where they do not.

    Raises TraceError for a step that the trace does not have, or for one step twice.
    """
    theory = checked_theory(theory).resolve(checked_trace(trace))
    for step in (first, second):
        if not is_whole(step) or not 0 <= step < len(trace):
            raise TraceError(
                f"step: expected a step from 0 to {len(trace) - 1}, got {brief(step)}; steps are counted from 0"
            )
    if first == second:
        raise TraceError(f"step: expected two steps, got {first} twice; take another one")
    displacement = _displacement(theory)
    return (
        displacement.returns_of(trace).why_apart(min(first, second), max(first, second))
        if displacement
        else None
    )


def _displacement(theory: Theory) -> Displacement | None:
    """What displacements say, where they take part in a theory."""
    return next(
        (evidence for evidence in evidence_of(theory) if isinstance(evidence, Displacement)), None
    )


@dataclass(frozen=True)
class Piece:
    """Some steps of a trace, as if they were all of it. A map of the whole trace, cut down to these steps, satisfies the axioms there.

    trace   the steps, numbered from 0. Where steps between two of them are left out, nothing is known of how the robot came from one to the other
    theory  with the pairs that a person speaks of in these numbers
    steps   which steps of the whole trace they are, ascending
    facts   what displacements say of pairs of them across what is left out
    """

    trace: Trace
    theory: Theory
    steps: tuple[int, ...]
    facts: str = ""

    @staticmethod
    def of(trace: Trace, theory: Theory, steps: Sequence[int]) -> Piece:
        """These steps of a trace, ascending, under a resolved theory."""
        kept: list[Step] = []
        for k, t in enumerate(steps):
            step = trace.steps[t]
            if k + 1 == len(steps):
                step = replace(step, action=None)
            elif steps[k + 1] != t + 1:
                step = replace(step, action=Action.that_slipped(t))
            if k and steps[k - 1] != t - 1 and step.displacement is not None:
                step = replace(step, displacement=None, covariance=None)
            kept.append(step)
        number = {t: k for k, t in enumerate(steps)}
        pairs = {
            name: tuple(
                (number[i], number[j])
                for i, j in getattr(theory, name)
                if i in number and j in number
            )
            for name in ASSERTIONS
        }
        gap = steps[-1] - steps[0] + 1 > len(steps)
        facts_across = _said_across(trace, theory, number) if gap else ""
        return Piece(
            replace(trace, steps=tuple(kept)), theory.replace(**pairs), tuple(steps), facts_across
        )


def _said_across(trace: Trace, theory: Theory, number: Mapping[int, int]) -> str:
    """What displacements of the whole trace say of pairs of these steps, as facts. The piece by itself does not know how its parts lie to each other."""
    displacement = _displacement(theory)
    if displacement is None:
        return ""
    pairs = displacement.pairs(trace)
    told = []
    for name, earlier in (
        ("excluded", pairs.apart),
        ("elsewhere", pairs.elsewhere if theory.level == "topological" else {}),
    ):
        told += [
            f"{name}({displacement.axiom},{number[i]},{number[t]})."
            for t, others in earlier.items()
            if t in number
            for i in others
            if i in number
        ]
    return "\n".join(told)


def shortest(longest: int, has_no_map: Callable[[int], bool]) -> int | None:
    """The least length that has no map; None if even the longest has one. It is found by bisection, as more steps never bring a map back."""
    short, long = 0, 1
    while not has_no_map(long):
        if long == longest:
            return None
        short, long = long, min(2 * long, longest)
    while long - short > 1:
        middle = (short + long) // 2
        short, long = (short, middle) if has_no_map(middle) else (middle, long)
    return long


class _Answer(NamedTuple):
    """What an answer of clingo says: the dstate and the place of each step, and a map of them, which is one only if no axiom is broken."""

    labels: tuple[int, ...]
    places: tuple[int | None, ...]
    ssh_map: SSHMap

    def has(self, equalities: Collection[Equality]) -> bool:
        """Whether all these equalities hold."""
        named = {"dstate": self.labels, "place": self.places}
        return all((named[e.of][e.first] == named[e.of][e.second]) == e.holds for e in equalities)


class _Seen(NamedTuple):
    """What an answer says in the course of an argument: its conclusions, which axioms are broken at which steps (as what makes them active), and which steps are one."""

    conclusions: frozenset[clingo.Symbol]
    broken: frozenset[clingo.Symbol]
    one: frozenset[clingo.Symbol]

    @classmethod
    def of(cls, model: clingo.Model) -> _Seen:
        return cls(*facts.read_argument(model))

    def suits(self, active: Sequence[clingo.Symbol], assumed: Sequence[Assumption]) -> bool:
        """Whether these axioms hold in it, and what is assumed of steps that are one."""
        return self.broken.isdisjoint(active) and all(
            (symbol in self.one) == true for symbol, true in assumed
        )


def _forget(_: clingo.Model) -> None:
    """Where only whether there is an answer matters."""


class Axioms:
    """The axioms of a piece of a trace, in clingo. Where `relaxed`, each axiom can be switched on or off at each step.

    What evidence finds out only once there is a map, clingo is told of then, and asked again.

    stop  asked now and then; when it returns True, Interrupted is raised
    """

    def __init__(self, piece: Piece, stop: Callable[[], bool], *, relaxed: bool = False) -> None:
        trace, theory = piece.trace, piece.theory
        self._trace, self._theory, self._first = trace, theory, piece.steps[0]
        self._evidence = evidence_of(theory)
        self._stop = stop
        self._told = 0  # rules that were added since
        self._conclusions: list[clingo.Symbol] = []
        self._seen: list[_Seen] = []
        self._last_core: tuple[
            int, ...
        ] = ()  # of what was assumed last, as clingo's literals, a part that cannot all hold
        self._control = clingo.Control(
            ["--warn=none", *(["--heuristic=Domain"] if relaxed else [])]
        )
        names = [name for name in facts.encoding_names(theory) if name != "preference"]
        for name in [*names, "explain", "derivation"] if relaxed else names:
            self._control.load(encodings.path(name))
        last = len(trace) - 1
        self._control.add(
            "base",
            [],
            facts.theory_facts(
                theory, len(trace) if relaxed else facts.most_paths(trace, theory, len(trace))
            )
            + facts.trace_facts(trace, theory, 0, len(trace)),
        )
        self._control.add("base", [], facts.own_rules(theory))
        self._control.add("base", [], piece.facts)
        parts = [
            ("base", list[clingo.Symbol]()),
            *(("step", facts.numbers(t)) for t in range(len(trace))),
            ("check", facts.numbers(last)),
        ]
        for start in range(0, len(parts), AT_A_TIME):
            if stop():
                raise Interrupted
            self._control.ground(parts[start : start + AT_A_TIME])
        self._control.assign_external(facts.query(last), True)
        self._control.assign_external(facts.run_by_steps(), True)
        # Whether a map can be drawn is asked of the whole piece, and only where each dstate is at one place: else nothing can be drawn.
        pairs = (
            (axiom, t)
            for axiom in theory.axioms
            for t in range(len(trace))
            if axiom != Planar.axiom or t == last
        )
        self._pairs = {facts.active(axiom, t): (axiom, t) for axiom, t in pairs} if relaxed else {}
        self._drawn = {facts.active(Planar.axiom, last)} & self._pairs.keys()
        self._placed = [
            symbol for symbol, (axiom, _) in self._pairs.items() if axiom == "one_place"
        ]
        if self._drawn:
            self._control.add("placed", [], facts.rests_on(Planar.axiom, last, "one_place"))
            self._control.ground([("placed", [])])

    @property
    def instances(self) -> tuple[clingo.Symbol, ...]:
        """Where the axioms are relaxed: each of them at each step, as what makes it active."""
        return tuple(self._pairs)

    def consistent(
        self, active: Sequence[clingo.Symbol] = (), assumed: Sequence[Assumption] = ()
    ) -> bool:
        """Whether there is a map. Where the axioms are relaxed, only the active ones have to hold.

        assumed  atoms that are true, or are false, in it
        """
        return self.map_with(active, assumed) is not None

    def map_with(
        self, active: Sequence[clingo.Symbol] = (), assumed: Sequence[Assumption] = ()
    ) -> SSHMap | None:
        """Such a map, if there is one."""
        while answer := self._answer(active, assumed):
            refused = self._refused(answer, {self._pairs[symbol] for symbol in active})
            if refused is None:
                return answer.ssh_map
            axiom, refusal = refused
            self._forbid(
                refusal,
                facts.active(axiom, self._judged_at(axiom, refusal)) if self._pairs else None,
            )
        return None

    def tell_of(self, steps: Iterable[int]) -> None:
        """From now on `consequences` are about these steps (encodings/derivation.lp)."""
        self._control.add("told_of", [], facts.told_of(steps))
        self._control.ground([("told_of", []), ("conclusions", [])])
        self._conclusions = facts.conclusions_of(self._control)
        self._control.add("may_fail", [], facts.may_fail(self._conclusions))
        self._control.ground([("may_fail", [])])

    def consequences(
        self,
        active: Sequence[clingo.Symbol],
        assumed: Sequence[Assumption] = (),
        known: Collection[clingo.Symbol] = (),
    ) -> frozenset[clingo.Symbol]:
        """The conclusions that hold in all maps in which these axioms hold. There has to be such a map.

        known  conclusions that are known to be among them
        """
        # Clingo's own way (cautious reasoning) loses atoms where it is asked under assumptions.
        found = frozenset(self._conclusions)
        holding = active if self._drawn.isdisjoint(active) else [*active, *self._placed]
        for answer in self._seen:
            if answer.suits(holding, assumed):
                found &= answer.conclusions

        def keep(model: clingo.Model) -> None:
            nonlocal found
            seen = _Seen.of(model)
            found &= seen.conclusions
            if not self._told:  # else an answer does not show all that is wrong with it
                self._seen.append(seen)

        doubtful = found - frozenset(known)
        for symbol in self._conclusions:
            self._control.assign_external(facts.picked(symbol), symbol in doubtful)
        while doubtful and self._solve(keep, active, [*assumed, (facts.some_fail(), True)]):
            for symbol in doubtful - found:
                self._control.assign_external(facts.picked(symbol), False)
            doubtful &= found
        return found

    def core(
        self, active: Sequence[clingo.Symbol], assumed: Sequence[Assumption]
    ) -> list[Assumption] | None:
        """Of what is assumed, a part that cannot all hold where these axioms do, none of which can be spared; None where all of it can hold.

        What comes first in `assumed` is taken rather than what comes later: the last that is taken comes as early as it can, then the one before, and so on.
        """
        needed: list[Assumption] = []
        rest = list(assumed)
        while self._solve(_forget, active, needed):
            least, most = 0, len(rest)  # `most` of the rest suffice, `least` do not
            if self._solve(_forget, active, [*rest, *needed]):
                return None
            most = min(most, 1 + max((rest.index(a) for a in self._of_last_core(rest)), default=-1))
            while most - least > 1:
                middle = (least + most) // 2
                if self._solve(_forget, active, [*rest[:middle], *needed]):
                    least = middle
                else:
                    most = min(
                        middle,
                        1
                        + max(
                            (rest.index(a) for a in self._of_last_core(rest[:middle])), default=-1
                        ),
                    )
                    most = max(most, least + 1)
            needed.append(rest[most - 1])
            rest = rest[: most - 1]
        return needed

    def _of_last_core(self, assumed: Sequence[Assumption]) -> list[Assumption]:
        """Those of these assumptions that clingo found to clash when it was asked last."""
        core = set(self._last_core)
        literals = [
            (assumption, self._control.symbolic_atoms[assumption[0]]) for assumption in assumed
        ]
        return [
            (symbol, true)
            for (symbol, true), atom in literals
            if atom is None or atom.literal * (1 if true else -1) in core
        ]

    def _answer(
        self, active: Sequence[clingo.Symbol], assumed: Sequence[Assumption] = ()
    ) -> _Answer | None:
        """An answer of clingo in which these axioms hold."""
        found: list[_Answer] = []

        def keep(model: clingo.Model) -> None:
            found.append(
                _Answer(*facts.read_steps(model), facts.read_map(model, self._trace, self._theory))
            )

        return found[0] if self._solve(keep, active, assumed) else None

    def _solve(
        self,
        keep: Callable[[clingo.Model], None],
        active: Sequence[clingo.Symbol],
        assumed: Sequence[Assumption],
    ) -> bool:
        """Whether there is an answer; each one found is kept."""
        if self._stop():
            raise Interrupted
        assumptions = [*((symbol, True) for symbol in active), *assumed]
        with self._control.solve(assumptions=assumptions, on_model=keep, async_=True) as handle:
            while not handle.wait(POLL):
                if self._stop():
                    handle.cancel()
                    raise Interrupted
            satisfiable = bool(handle.get().satisfiable)
            self._last_core = () if satisfiable else tuple(handle.core())
            return satisfiable

    def _refused(
        self, answer: _Answer, active: Collection[tuple[str, int]]
    ) -> tuple[str, Refusal] | None:
        """What some evidence finds out cannot all hold in an answer, and its axiom. Where the axioms are relaxed, that has to be active at the last of the steps."""
        for evidence in self._evidence:
            if not self._pairs:
                found = [evidence.refuse(self._trace, answer.ssh_map)]
            elif isinstance(evidence, Displacement):
                found = [
                    self._refused_together(evidence, answer, t)
                    for axiom, t in sorted(active)
                    if axiom == evidence.axiom
                ]
            else:
                found = (
                    [evidence.refuse(self._trace, answer.ssh_map)]
                    if any(axiom == evidence.axiom for axiom, _ in active)
                    else []
                )
            for refusal in filter(None, found):
                if not self._pairs or (
                    answer.has(refusal)
                    and (evidence.axiom, self._judged_at(evidence.axiom, refusal)) in active
                ):
                    return evidence.axiom, refusal
        return None

    def _judged_at(self, axiom: str, refusal: Refusal) -> int:
        """The step at which an axiom has to be active for this to be refused."""
        return len(self._trace) - 1 if axiom == Planar.axiom else _last_step(refusal)

    def _refused_together(
        self, displacement: Displacement, answer: _Answer, step: int
    ) -> Refusal | None:
        """Two returns of an answer that are refused together, the later of which ends at a step."""
        if displacement.joint == 1:
            return None
        return displacement.returns_of(self._trace).refused_at(answer.labels, answer.places, step)

    def _forbid(self, refusal: Refusal, where: clingo.Symbol | None = None) -> None:
        """Tell clingo that not all of these equalities hold; where an atom is given, only if that holds."""
        name = f"told_{self._told}"
        self._told += 1
        self._control.add(name, [], facts.forbidden_equalities(refusal, where))
        self._control.ground([(name, [])])

    def sentences(self, clash: Sequence[tuple[str, int]]) -> tuple[str, ...]:
        """What displacements say of the returns that take part in a clash, as in Explanation.

        The other clashes leave answers, in each of which some return is refused. The clearest of them is forbidden, until there is no answer left.
        """
        displacement = _displacement(self._theory)
        steps = [t for axiom, t in clash if displacement and axiom == displacement.axiom]
        if not displacement or not steps:
            return ()
        returns = displacement.returns_of(self._trace)
        said: dict[int, list[tuple[float, str]]] = {t: [] for t in steps}
        others = [
            symbol
            for symbol, pair in self._pairs.items()
            if pair in clash and pair[0] != displacement.axiom
        ]
        while answer := self._answer(others):
            alone = [
                e for t in steps for e in returns.refused_alone_at(answer.labels, answer.places, t)
            ]
            if alone:
                clearest = max(alone, key=returns.excess)
                refusal: Refusal | None = frozenset([clearest])
                found = (
                    returns.excess(clearest),
                    returns.why_apart(clearest.first, clearest.second, self._first) or "",
                )
            else:
                refusal = next(
                    filter(None, (self._refused_together(displacement, answer, t) for t in steps)),
                    None,
                )
                found = 0.0, returns.why_not_both(refusal or (), self._first)
            if refusal is None:
                break
            said[_last_step(refusal)].append(found)
            self._forbid(refusal)
        clearest_first = (sorted(said[t], reverse=True)[:MOST_SENTENCES] for t in sorted(steps))
        return tuple(dict.fromkeys(sentence for found in clearest_first for _, sentence in found))

    def smallest_clash(self, assumed: Sequence[Assumption] = ()) -> list[tuple[str, int]]:
        """Pairs of axiom and step that leave no map, while any proper subset of them leaves one.

        There are many such sets. To get one that is short to read, whole axioms are dropped before single steps, once in the order of the axioms and once
        in reverse, and the smaller result is returned.
        """
        found = [
            self._shrunk(list(order), assumed) for order in (self._pairs, reversed(self._pairs))
        ]
        shortest = min(
            found, key=lambda pairs: (len({self._pairs[p][0] for p in pairs}), len(pairs))
        )
        return [self._pairs[symbol] for symbol in shortest]

    def _shrunk(
        self, kept: list[clingo.Symbol], assumed: Sequence[Assumption]
    ) -> list[clingo.Symbol]:
        """Pairs that still leave no map after all that can be dropped were dropped, in their order."""
        core: set[clingo.Symbol] | None = (
            None  # some that clingo found to clash: while all of them are kept there is no need to ask
        )

        def clash(some: list[clingo.Symbol]) -> bool:
            nonlocal core
            if core is None or not core <= set(some):
                if self.consistent(some, assumed):
                    return False
                core = {
                    symbol for symbol, _ in self._of_last_core([(symbol, True) for symbol in some])
                }
            return True

        for axiom in dict.fromkeys(self._pairs[symbol][0] for symbol in kept):
            fewer = [symbol for symbol in kept if self._pairs[symbol][0] != axiom]
            if clash(fewer):
                kept = fewer
        for symbol in tuple(kept):
            fewer = [other for other in kept if other != symbol]
            if clash(fewer):
                kept = fewer
        return kept


def _last_step(refusal: Refusal) -> int:
    """The last of the steps that these equalities are about."""
    return max(max(e.first, e.second) for e in refusal)
