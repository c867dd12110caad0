"""The axioms of a piece of a trace in clingo. Each can be switched on or off at each step."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, TypeAlias

import clingo

from ssh_abduction.data.corrections import ASSERTIONS
from ssh_abduction.data.drives import drives_of, named_steps
from ssh_abduction.data.groups import minimal_part
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.odometry import closures_among
from ssh_abduction.data.trace import Action, Step, Trace
from ssh_abduction.runtime.clock import POLL
from ssh_abduction.solver import Control, facts
from ssh_abduction.theory import encodings
from ssh_abduction.theory.evidence import Displacement, Equality, Planar
from ssh_abduction.theory.settle import Problem, displacement_of
from ssh_abduction.theory.theory import Theory

# The number of steps that are grounded between two calls of `stop`.
AT_A_TIME = 8
# Say why at most this many returns with the same last step are rejected.
MOST_SENTENCES = 3

# An atom and whether it is true.
Assumption: TypeAlias = tuple[clingo.Symbol, bool]
# Equalities (two steps are one dstate or at one place, or are not) that cannot all hold.
Refusal: TypeAlias = frozenset[Equality]


# The atom that holds if at least one of the picked conclusions does not hold.
SOME_FAIL = clingo.Function("some_fail")


class Interrupted(Exception):  # noqa: N818 - not an error
    """Raised to end the work because the caller's function `stop` returned True."""


class _ModelMap(NamedTuple):
    """A model of clingo, read as a map. If axioms are relaxed, the map may break some of them."""

    labels: tuple[int, ...]
    places: tuple[int | None, ...]
    ssh_map: SSHMap

    @classmethod
    def of(cls, model: clingo.Model, piece: Piece) -> _ModelMap:
        """Read a model of clingo for a piece."""
        found: dict[str, dict[int, int]] = {"is": {}, "at": {}}
        for name, args in map(facts.read_atom, model.symbols(shown=True)):
            if name in found:
                found[name][args[0]] = args[1]
        steps = range(len(piece.trace))
        labels = tuple(found["is"][t] for t in steps)
        places = tuple(found["at"].get(t) for t in steps)
        return cls(labels, places, facts.read_map(model, piece.trace, piece.theory))

    def has(self, equalities: Collection[Equality]) -> bool:
        """Tell whether all these (in)equalities of steps hold in the model."""
        named = {"dstate": self.labels, "place": self.places}
        return all((named[e.of][e.first] == named[e.of][e.second]) == e.holds for e in equalities)


def active_at(axiom: str, t: int) -> clingo.Symbol:
    """Return the atom that says that an axiom must hold at step t (explain.lp)."""
    return clingo.Function("active", [clingo.Function(axiom), *facts.number_symbols(t)])


def conclusion_of(name: str, *steps: int) -> clingo.Symbol:
    """Return the atom of a conclusion, such as `one_dstate`, about some steps."""
    return clingo.Function("so", [clingo.Function(name, facts.number_symbols(*steps))])


def read_conclusion(symbol: clingo.Symbol) -> tuple[str, tuple[int, ...]]:
    """Return the name and the steps of a conclusion, from its atom."""
    said = symbol.arguments[0]
    return said.name, tuple(argument.number for argument in said.arguments)


def picked(symbol: clingo.Symbol) -> clingo.Symbol:
    """Return the external atom that picks a conclusion for SOME_FAIL."""
    return clingo.Function("picked", [symbol])


def _forget(_: clingo.Model) -> None:
    """Ignore a model. For queries that ask only whether a model exists."""


class Axioms:
    """The axioms of a piece of a trace, in clingo.

    Some evidence, such as two returns together, can only judge a whole map. If it rejects a map
    that clingo found, the reason is added as a constraint, and clingo is asked again. Axioms that
    can be switched on and off (*relaxed*) have an `active` atom for each step.
    """

    def __init__(self, piece: Piece, stop: Callable[[], bool], *, relaxed: bool = False) -> None:
        """Ground the axioms.

        `stop` is called now and then. If it returns True, Interrupted is raised. If
        `relaxed`, each axiom can be switched on or off at each step. If not, all hold.
        """
        trace, theory = piece.trace, piece.theory
        self._piece = piece
        self._stop = stop
        self._conclusions: list[clingo.Symbol] = []
        self._picked = frozenset[clingo.Symbol]()  # in a query, one of these has to fail
        self._control = Control(["--heuristic=Domain"] if relaxed else [])
        self._ground(piece, relaxed=relaxed)
        last = len(trace) - 1
        # Planarity is checked once, at the last step, and only if each dstate is at one place:
        # otherwise there is nothing to draw.
        pairs = (
            (axiom, t)
            for axiom in theory.axioms
            for t in range(len(trace))
            if axiom != Planar.axiom or t == last
        )
        self._pairs = {active_at(axiom, t): (axiom, t) for axiom, t in pairs} if relaxed else {}
        if (drawn := active_at(Planar.axiom, last)) in self._pairs:
            self._control.tell(f":- {drawn}, violation(one_place,T).")

    def _ground(self, piece: Piece, *, relaxed: bool) -> None:
        """Ground the axioms for all steps. Raises Interrupted if `stop` returns True."""
        trace, theory = piece.trace, piece.theory
        names = [name for name in facts.encoding_names(theory) if name != "preference"]
        for name in [*names, "explain", "derivation"] if relaxed else names:
            self._control.load(encodings.path(name))
        last = len(trace) - 1
        paths = len(trace) if relaxed else facts.most_paths(trace, theory, len(trace))
        self._control.add("base", [], facts.theory_facts(theory, paths))
        self._control.add("base", [], facts.trace_facts(piece.problem, 0, len(trace)))
        self._control.add("base", [], facts.own_rules(theory))
        self._control.add("base", [], piece.facts)
        parts = [
            ("base", list[clingo.Symbol]()),
            *(("step", facts.number_symbols(t)) for t in range(len(trace))),
            ("check", facts.number_symbols(last)),
        ]
        for start in range(0, len(parts), AT_A_TIME):
            if self._stop():
                raise Interrupted
            self._control.ground(parts[start : start + AT_A_TIME])
        self._control.assign_external(facts.query(last), True)
        self._control.assign_external(facts.run_by_steps(), True)

    def consistent(
        self, active: Sequence[clingo.Symbol] = (), assumed: Sequence[Assumption] = ()
    ) -> bool:
        """Tell whether a map satisfies the axioms and the assumptions.

        An assumption is an atom and whether it is true. If the axioms are relaxed, only those
        with an atom in `active` have to hold.
        """
        return self.map_with(active, assumed) is not None

    def map_with(
        self, active: Sequence[clingo.Symbol] = (), assumed: Sequence[Assumption] = ()
    ) -> SSHMap | None:
        """Find a map. Parameters as in `consistent`."""
        while answer := self._answer(active, assumed):
            refused = self._refused(answer, {self._pairs[symbol] for symbol in active})
            if refused is None:
                return answer.ssh_map
            axiom, refusal = refused
            where = active_at(axiom, self._judged_at(axiom, refusal)) if self._pairs else None
            self._forbid(refusal, where)
        return None

    def tell_of(self, steps: Iterable[int]) -> None:
        """Set the steps that the conclusions of `consequences` are about.

        The file encodings/derivation.lp defines the possible conclusions.
        """
        self._control.tell(" ".join(f"told_of({t})." for t in sorted({*steps})))
        self._control.ground([("conclusions", [])])
        possible = self._control.symbolic_atoms.by_signature("so", 1)
        self._conclusions = [atom.symbol for atom in possible]
        self._control.tell(
            "\n".join(
                f"#external {picked(c)}. {SOME_FAIL} :- {picked(c)}, not {c}. "
                f"#heuristic {c} : {picked(c)}. [1,false]"
                for c in self._conclusions
            )
        )

    def consequences(
        self,
        active: Sequence[clingo.Symbol],
        assumed: Sequence[Assumption] = (),
        known: Collection[clingo.Symbol] = (),
    ) -> frozenset[clingo.Symbol]:
        """Find the conclusions that hold in all maps that satisfy these axioms and assumptions.

        Arguments are as in `consistent`. There must be such a map. `known` has conclusions
        that are already known to hold, which saves time.
        """
        # Clingo's cautious reasoning loses atoms under assumptions. So each query asks for a model
        # in which at least one unproven conclusion fails, until there is none.
        found = frozenset(self._conclusions)

        def keep(model: clingo.Model) -> None:
            nonlocal found
            found &= {symbol for symbol in model.symbols(atoms=True) if symbol.name == "so"}

        doubtful = found - frozenset(known)
        self._pick(doubtful)
        while doubtful and self._solve(keep, active, [*assumed, (SOME_FAIL, True)]):
            doubtful &= found
            self._pick(doubtful)
        return found

    def _pick(self, doubtful: frozenset[clingo.Symbol]) -> None:
        """Ask the next query for a model in which one of these conclusions fails."""
        for symbol in doubtful ^ self._picked:
            self._control.assign_external(picked(symbol), symbol in doubtful)
        self._picked = doubtful

    def core(
        self, active: Sequence[clingo.Symbol], assumed: Sequence[Assumption]
    ) -> list[Assumption] | None:
        """Find a minimal subset of the assumptions that contradicts these axioms, or None.

        Arguments are as in `consistent`. Early assumptions are preferred to late ones.
        """
        if self._solve(_forget, active, assumed):
            return None
        if not self._solve(_forget, active, []):
            return []
        return minimal_part(lambda some: not self._solve(_forget, active, some), [*assumed])

    def _answer(
        self, active: Sequence[clingo.Symbol], assumed: Sequence[Assumption] = ()
    ) -> _ModelMap | None:
        """Find a model of clingo in which these axioms hold; None if there is none."""
        found: list[_ModelMap] = []

        def keep(model: clingo.Model) -> None:
            found.append(_ModelMap.of(model, self._piece))

        return found[0] if self._solve(keep, active, assumed) else None

    def _solve(
        self,
        keep: Callable[[clingo.Model], None],
        active: Sequence[clingo.Symbol],
        assumed: Sequence[Assumption],
    ) -> bool:
        """Tell whether there is a model, and call `keep` with the model found."""
        if self._stop():
            raise Interrupted
        assumptions = [*((symbol, True) for symbol in active), *assumed]
        with self._control.searching(assumptions=assumptions, on_model=keep) as handle:
            while not handle.wait(POLL):
                if self._stop():
                    raise Interrupted
            return bool(handle.get().satisfiable)

    def _refused(
        self, answer: _ModelMap, active: Collection[tuple[str, int]]
    ) -> tuple[str, Refusal] | None:
        """Find equalities of a model that some evidence rejects, with the axiom of the evidence.

        If axioms are relaxed, a rejection counts only if its axiom is active at the step that
        `_judged_at` returns.
        """
        for evidence in self._piece.problem.evidence:
            steps = [t for axiom, t in sorted(active) if axiom == evidence.axiom]
            if self._pairs and isinstance(evidence, Displacement):
                found = [self._refused_together(evidence, answer, t) for t in steps]
            elif steps or not self._pairs:
                found = [evidence.refuse(self._piece.trace, answer.ssh_map)]
            else:
                continue
            for refusal in filter(None, found):
                if not self._pairs or (
                    answer.has(refusal)
                    and (evidence.axiom, self._judged_at(evidence.axiom, refusal)) in active
                ):
                    return evidence.axiom, refusal
        return None

    def _judged_at(self, axiom: str, refusal: Refusal) -> int:
        """Return the step at which the axiom has to be active for a rejection to count."""
        return len(self._piece.trace) - 1 if axiom == Planar.axiom else _last_step(refusal)

    def _refused_together(
        self, displacement: Displacement, answer: _ModelMap, step: int
    ) -> Refusal | None:
        """Find two returns that displacements reject together. The later one ends at `step`."""
        if displacement.joint == 1:
            return None
        return displacement.returns_of(self._piece.trace).refused_at(
            answer.labels, answer.places, step
        )

    def _forbid(self, refusal: Refusal, where: clingo.Symbol | None = None) -> None:
        """Add a constraint: while the atom `where` is true, these equalities do not all hold."""
        self._control.tell(facts.forbidden_equalities(refusal, where))

    def sentences(self, clash: Sequence[tuple[str, int]]) -> tuple[str, ...]:
        """Describe the returns that displacements reject in a clash.

        `clash` is a set of pairs (axiom, step) that no map satisfies, as from `smallest_clash`.
        Without displacements the axioms of the clash have models. Each of these models has
        a return (two steps at one place or dstate) that displacements reject. This method
        describes the return that is rejected most clearly, forbids it, and repeats this until no
        model is left.
        """
        displacement = displacement_of(self._piece.problem)
        steps = [t for axiom, t in clash if displacement and axiom == displacement.axiom]
        if not displacement or not steps:
            return ()
        returns = displacement.returns_of(self._piece.trace)
        said: dict[int, list[tuple[float, str]]] = {t: [] for t in steps}
        kept = {pair for pair in clash if pair[0] != displacement.axiom}
        others = [symbol for symbol, pair in self._pairs.items() if pair in kept]
        while answer := self._answer(others):
            # single returns come first: their sentence is simpler
            alone = [
                e for t in steps for e in returns.refused_alone_at(answer.labels, answer.places, t)
            ]
            if alone:
                clearest = max(alone, key=returns.excess)
                refusal: Refusal | None = frozenset([clearest])
                why = returns.why_apart(clearest.first, clearest.second, self._piece.steps)
                found = returns.excess(clearest), why or ""
            else:
                both = (self._refused_together(displacement, answer, t) for t in steps)
                refusal = next(filter(None, both), None)
                found = 0.0, returns.why_not_both(refusal or (), self._piece.steps)
            if refusal is None:
                break
            said[_last_step(refusal)].append(found)
            self._forbid(refusal)
        clearest_first = (sorted(said[t], reverse=True)[:MOST_SENTENCES] for t in sorted(steps))
        return tuple(dict.fromkeys(sentence for found in clearest_first for _, sentence in found))

    def smallest_clash(self, assumed: Sequence[Assumption] = ()) -> list[tuple[str, int]]:
        """Find a minimal set of pairs (axiom, step) that no map with these assumptions satisfies.

        There are many minimal sets. To get a short one, whole axioms are dropped before single
        steps, once in the order of the axioms and once in reverse. The smaller result is returned.
        """
        found = [
            self._shrunk(list(order), assumed) for order in (reversed(self._pairs), self._pairs)
        ]
        shortest = min(
            found, key=lambda pairs: (len({self._pairs[p][0] for p in pairs}), len(pairs))
        )
        return [self._pairs[symbol] for symbol in shortest]

    def _shrunk(
        self, order: list[clingo.Symbol], assumed: Sequence[Assumption]
    ) -> list[clingo.Symbol]:
        """Drop unneeded pairs (axiom, step), whole axioms first. Earlier pairs rather stay."""

        def clash(some: list[clingo.Symbol]) -> bool:
            return not self.consistent(some, assumed)

        def of_axioms(axioms: list[str]) -> list[clingo.Symbol]:
            return [symbol for symbol in order if self._pairs[symbol][0] in axioms]

        names = [*dict.fromkeys(self._pairs[symbol][0] for symbol in order)]
        needed = minimal_part(lambda some: clash(of_axioms(some)), names)
        return minimal_part(clash, of_axioms(needed))


def _last_step(refusal: Refusal) -> int:
    """Find the last step that these equalities are about."""
    return max(max(e.first, e.second) for e in refusal)


@dataclass(frozen=True)
class Piece:
    """Some steps of a trace, made into a trace of their own.

    A map of the whole trace, restricted to these steps, satisfies the axioms at these steps. So if
    the piece has no map, the whole trace has none.
    """

    # A trace of these steps, numbered from 0, and the theory. Where steps are left out, the action
    # and the displacement are unknown. The pairs of steps that a user asserted to be the same or
    # different are renumbered in the theory.
    problem: Problem
    # The steps by their numbers in the whole trace, ascending. In sentences, steps of several
    # drives have the names of their drives.
    steps: tuple[int, ...]
    # Clingo facts for the pairs of steps that displacements exclude from being at one dstate, or at
    # one place. Empty if no steps are left out between the first and the last.
    facts: str = ""

    @property
    def trace(self) -> Trace:
        """The trace of the piece, with steps numbered from 0."""
        return self.problem.trace

    @property
    def theory(self) -> Theory:
        """The theory. Pairs of steps that a user asserted have the step numbers of the piece."""
        return self.problem.theory

    @staticmethod
    def of(problem: Problem, steps: Sequence[int]) -> Piece:
        """Make the piece that has these steps, ascending, of the trace of a problem."""
        trace, theory = problem.trace, problem.theory
        kept: list[Step] = []
        for k, t in enumerate(steps):
            step = trace.steps[t]
            # where steps are left out, the action and the displacement are unknown
            if k + 1 == len(steps):
                step = replace(step, action=None)
            elif steps[k + 1] != t + 1:
                step = replace(step, action=Action.that_slipped(t))
            if k and steps[k - 1] != t - 1 and step.displacement is not None:
                step = replace(step, displacement=None, covariance=None)
            kept.append(step)
        names = named_steps(drives_of(trace), len(trace))
        number = {t: k for k, t in enumerate(steps)}
        pairs = {
            name: tuple(
                (number[i], number[j])
                for i, j in getattr(theory, name)
                if i in number and j in number
            )
            for name in ASSERTIONS
        }
        closures = closures_among(trace.closures, steps)
        alone = replace(trace, steps=tuple(kept), closures=closures)
        gap = steps[-1] - steps[0] + 1 > len(steps)
        return Piece(
            problem.changed(alone, theory.replace(**pairs)),
            tuple(names[t] for t in steps),
            _said_across(problem, number) if gap else "",
        )


def _said_across(problem: Problem, number: Mapping[int, int]) -> str:
    """Write clingo facts about the pairs of steps that displacements rule out.

    The facts are computed from the whole trace, as the piece lacks the displacements of the steps
    that are left out.
    """
    displacement = displacement_of(problem)
    if displacement is None:
        return ""
    pairs = displacement.pairs(problem.trace)
    rules = []
    for name, earlier in (
        ("excluded", pairs.apart),
        ("elsewhere", pairs.elsewhere if problem.theory.level == "topological" else {}),
    ):
        rules += [
            f"{name}({displacement.axiom},{number[i]},{number[t]})."
            for t, others in earlier.items()
            if t in number
            for i in others
            if i in number
        ]
    return "\n".join(rules)
