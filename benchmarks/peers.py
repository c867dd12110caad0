"""Other programs that find small Moore machines: functions from a trace to the machine they find.

The causal theory asks for the smallest deterministic Moore machine that explains a trace. These
programs ask for the same. Each function gets the whole trace, and nothing that our solver found
out. Its docstring says in which form the program gets the trace, and what the answer means.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from itertools import count
from pathlib import Path
from typing import Any

from ssh_abduction import Trace


class NotApplicableError(Exception):
    """A program cannot solve an instance. The message says why."""


@dataclass(frozen=True)
class Machine:
    """A Moore machine.

    Attributes:
        start: The start state.
        follow: Function from a state and the name of an action to the next state.
        shows: Function from a state to its view.
    """

    start: Any
    follow: Callable[[Any, str], Any]
    shows: Callable[[Any], Any]

    def states(self, trace: Trace) -> int | None:
        """Run the machine along a trace.

        Returns:
            The number of states that are visited; None if a state shows another view than the
            trace.
        """
        state, visited = self.start, set()
        for step in trace:
            if self.shows(state) != step.view:
                return None
            visited.add(state)
            if step.action:
                state = self.follow(state, step.action.name)
        return len(visited)


@dataclass(frozen=True)
class Peer:
    """A program.

    Attributes:
        find: Function from a trace to the machine that the program finds.
        modules: Modules that the function imports.
        packages: Packages whose versions are reported; the first one is to install.
        proves: Whether the program proves that its machine is minimal.
    """

    find: Callable[[Trace], Machine]
    modules: tuple[str, ...]
    packages: tuple[str, ...]
    proves: bool

    @property
    def installed(self) -> bool:
        return all(find_spec(module.partition(".")[0]) for module in self.modules)


class Words:
    """A trace as labelled words over the letters "0", "1", …, for learners of DFAs.

    Such learners get accepted and rejected words. The views are numbered. The actions up to a step
    are a word. It is accepted if the lowest bit of the number of the step's view is 1. Each further
    bit has a letter of its own. The word of the actions, followed by that letter, is accepted if
    the bit is 1.

    The smallest DFA and the smallest Moore machine have the same number of states. A DFA gives a
    machine: take the states that the trace visits, each with its bits, which the DFA answers. A
    machine gives a DFA: a state is accepting if its lowest bit is 1, and the letter of another bit
    leads to any accepting or to any rejecting state. Both kinds of states exist if there are at
    least two views.
    """

    def __init__(self, trace: Trace) -> None:
        self.views = list(dict.fromkeys(trace.views))
        self.actions = {
            name: str(i) for i, name in enumerate(dict.fromkeys(a.name for a in trace.actions))
        }
        bits = max(1, (len(self.views) - 1).bit_length())
        self.questions = [str(len(self.actions) + i) for i in range(bits - 1)]
        self._numbers = [self.views.index(view) for view in trace.views]
        self._done = [self.actions[a.name] for a in trace.actions]
        self.all_done_by = (
            max(self._done.index(letter) for letter in self.actions.values()) + 2
            if self._done
            else 1
        )

    def __len__(self) -> int:
        """Return the number of steps of the trace."""
        return len(self._numbers)

    def at(self, step: int) -> Iterator[tuple[list[str], bool]]:
        """Yield the words of a step, each with a flag that says whether it is accepted."""
        done, number = self._done[:step], self._numbers[step]
        yield done, bool(number & 1)
        for i, letter in enumerate(self.questions, 1):
            yield [*done, letter], bool(number >> i & 1)

    def machine(
        self, start: Any, follow: Callable[[Any, str], Any], accepts: Callable[[Any], bool]
    ) -> Machine:
        """Make the Moore machine of a DFA over these letters.

        Args:
            start: Start state of the DFA.
            follow: Function from a state and a letter to the next state.
            accepts: Function from a state to whether it is accepting.
        """

        def shows(state: Any) -> Any:
            number = sum(
                accepts(s) << i
                for i, s in enumerate(
                    [state, *(follow(state, letter) for letter in self.questions)]
                )
            )
            return self.views[number] if number < len(self.views) else None

        return Machine(start, lambda state, action: follow(state, self.actions[action]), shows)


def plain(trace: Trace) -> Machine:
    """Find a machine by plain.lp in clingo.

    The number of states grows, beginning with the number of views. So the first machine is the
    smallest.
    """
    import clingo

    views, actions = (
        list(dict.fromkeys(trace.views)),
        list(dict.fromkeys(a.name for a in trace.actions)),
    )
    facts = [f"view({t},{views.index(view)})." for t, view in enumerate(trace.views)]
    facts += [f"act({t},{actions.index(action.name)})." for t, action in enumerate(trace.actions)]
    for k in count(len(views)):
        control = clingo.Control(["--warn=none", "-c", f"k={k}"])
        control.load(str(Path(__file__).with_name("plain.lp")))
        control.add("base", [], "\n".join(facts))
        control.ground()
        with control.solve(yield_=True) as handle:
            if model := handle.model():
                found = [
                    (atom.name, [x.number for x in atom.arguments])
                    for atom in model.symbols(shown=True)
                ]
                break
    shows = {s: views[v] for name, (s, v, *_) in found if name == "shows"}
    leads = {(args[0], actions[args[1]]): args[2] for name, args in found if name == "leads"}
    return Machine(0, lambda state, action: leads[state, action], shows.get)


def dfainductor(trace: Trace) -> Machine:
    """Find a machine by DFA-Inductor, which uses SAT.

    The number of states grows, beginning with the number of views. So the first DFA is the
    smallest. DFA-Inductor gets the trace as `Words`. It runs with its defaults: it breaks
    symmetries breadth-first, and uses no inconsistency graph. It gets the words of the first 100
    steps. Then the words of the first ten steps at which a DFA is wrong are added, again and again.
    On long traces this is much faster than all words at once. Words are made when they are needed,
    as their total length is quadratic in the length of the trace.

    Raises:
        NotApplicableError: There are more than ten letters.
    """
    from dfainductor.algorithms.searchers import LSUS
    from dfainductor.examples import BaseExamplesProvider
    from dfainductor.structures import APTA, DFA, InconsistencyGraph

    words = Words(trace)
    if len(words.actions) + len(words.questions) > 10:
        raise NotApplicableError("more than ten letters, which it reads back in a wrong order")

    class Examples(BaseExamplesProvider):
        def __init__(self) -> None:
            pass

        def _written(self, steps: Iterator[int] | range) -> list[str]:
            return [
                f"{accepted:d} {len(word)} {' '.join(word)}"
                for t in steps
                for word, accepted in words.at(t)
            ]

        def get_init_examples(self) -> list[str]:
            return self._written(range(min(len(words), max(100, words.all_done_by))))

        def get_counter_examples(self, dfa: DFA) -> list[str]:
            machine = moore(dfa)
            state, wrong = machine.start, []
            for t, step in enumerate(trace):
                if machine.shows(state) != step.view:
                    wrong.append(t)
                if step.action is None or len(wrong) == 10:
                    break
                state = machine.follow(state, step.action.name)
            return self._written(wrong)

        def _init_examples_size(self) -> int:
            raise NotImplementedError

        _counter_examples_size = _init_examples_size

    def moore(dfa: DFA) -> Machine:
        return words.machine(
            dfa.get_start(),
            lambda state, letter: state.get_child(letter),
            lambda state: state.is_accepting(),
        )

    examples = Examples()
    apta = APTA(examples.get_init_examples())
    search = LSUS(
        apta,
        InconsistencyGraph(apta, is_empty=True),
        "cadical153",
        "BFS",
        "lin-abs",
        examples,
        "none",
    )
    return moore(search.search(len(words.views), len(words)))


def z3gi(trace: Trace) -> Machine:
    """Find a machine by z3gi, which uses SMT.

    The number of states grows, beginning with the number of views. So the first DFA is the
    smallest. z3gi gets the trace as `Words`, all at once. Its encoding is the one with a node per
    word and without quantifiers, which is its fastest for these traces.
    """
    import z3
    from z3gi.encoders import expressive
    from z3gi.sample import Sample

    words = Words(trace)
    sys.setrecursionlimit(
        max(sys.getrecursionlimit(), 10 * len(words))
    )  # it reads a word by one nested call for each letter
    encoder = expressive.Encoder(quantifiers=False)
    sample = Sample(encoder)
    for t in range(len(words)):
        for word, accepted in words.at(t):
            sample[word] = accepted
    model = sample.model(z3.Solver(), minstates=len(words.views), maxstates=len(words) + 1)

    @cache
    def follow(state: int, letter: str) -> int:
        return model.eval(encoder.trans(state, encoder.alphabet[letter])).as_long()

    @cache
    def accepts(state: int) -> bool:
        return bool(model.eval(encoder.out(state)))

    return words.machine(model.eval(encoder.repr(encoder.apt.name)).as_long(), follow, accepts)


def rpni(trace: Trace) -> Machine:
    """Find a machine by AALpy's RPNI, which merges states in a fixed order if possible.

    The machine explains the trace, but need not be the smallest.
    """
    from aalpy.learning_algs import run_RPNI

    done = tuple(action.name for action in trace.actions)
    return _of_aalpy(
        run_RPNI(
            [(done[:t], view) for t, view in enumerate(trace.views)], "moore", print_info=False
        )
    )


def gsm(trace: Trace) -> Machine:
    """Find a machine by AALpy's general state merging, which does the largest merge first.

    The machine explains the trace, but need not be the smallest.
    """
    from aalpy.learning_algs import run_GSM
    from aalpy.learning_algs.general_passive.GsmNode import GsmNode
    from aalpy.learning_algs.general_passive.ScoreFunctionsGSM import (
        EDSM_score,
        SimpleScoreCalculation,
    )

    walk = [
        trace.views[0],
        *((action.name, view) for action, view in zip(trace.actions, trace.views[1:], strict=True)),
    ]
    score = SimpleScoreCalculation(GsmNode.deterministic_compatible, EDSM_score())
    # Ignore the warning that not all actions were tried in all states.
    with warnings.catch_warnings(action="ignore"):
        return _of_aalpy(run_GSM([walk], score_calc=score, data_format="io_traces"))


def _of_aalpy(machine: Any) -> Machine:
    return Machine(
        machine.initial_state,
        lambda state, action: state.transitions[action],
        lambda state: state.output,
    )


PEERS = {
    "plain.lp": Peer(plain, ("clingo",), ("clingo",), proves=True),
    "dfainductor": Peer(
        dfainductor,
        ("dfainductor.algorithms.searchers",),
        ("dfainductor", "python-sat"),
        proves=True,
    ),
    "z3gi": Peer(z3gi, ("z3gi.sample",), ("z3gi", "z3-solver"), proves=True),
    "RPNI": Peer(rpni, ("aalpy.learning_algs",), ("aalpy",), proves=False),
    "GSM": Peer(gsm, ("aalpy.learning_algs",), ("aalpy",), proves=False),
}
