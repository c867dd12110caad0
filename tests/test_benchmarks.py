"""The benchmarks measure what they say: the peers explain the trace, with as few states as they promise."""

from __future__ import annotations

import random

import pytest
from instances import moore
from peers import PEERS, Machine, Words

from ssh_abduction import Theory, Trace, solve


def fewest(trace: Trace) -> int:
    cost = solve(trace, Theory.causal(), maps=1).cost
    assert cost
    return cost.dstates


def tiny(seed: int) -> Trace:
    chance = random.Random(seed)
    states = chance.randint(1, 4)
    return moore(states, chance.randint(1, states), steps=chance.randint(0, 14), seed=seed, actions=chance.randint(1, 3)).trace


@pytest.mark.parametrize("name", PEERS)
def test_a_peer_explains_the_trace_with_as_few_states_as_it_promises(name: str) -> None:
    peer = PEERS[name]
    if not peer.installed:
        pytest.skip(f"{name} is not installed")
    for seed in range(12):
        trace = tiny(seed)
        states = peer.find(trace).states(trace)
        assert states is not None, seed
        assert states == fewest(trace) if peer.proves else states >= fewest(trace), seed


def test_the_plain_encoding_agrees_with_the_solver() -> None:
    for seed in range(100, 140):
        assert PEERS["plain.lp"].find(tiny(seed)).states(tiny(seed)) == fewest(tiny(seed)), seed


def test_a_machine_that_shows_something_else_is_found_out() -> None:
    trace = Trace.from_steps(["a", "b", "a"], ["travel", "travel"])
    right = Machine(0, lambda state, _: 1 - state, lambda state: "ab"[state])
    wrong = Machine(0, lambda state, _: min(state + 1, 1), lambda state: "ab"[state])
    assert (right.states(trace), wrong.states(trace)) == (2, None)


def test_words_ask_for_the_view_bit_by_bit() -> None:
    words = Words(Trace.from_steps(["a", "b", "c", "b"], ["travel", "right", "travel"]))
    assert [list(words.at(t)) for t in (0, 2)] == [[([], False), (["2"], False)], [(["0", "1"], False), (["0", "1", "2"], True)]]
