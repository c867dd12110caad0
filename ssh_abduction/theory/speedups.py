"""What makes solving fast, each to be switched off alone: for tests, and to see what it gains (docs/performance.md)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields

from ssh_abduction.errors import SolverError, brief


@dataclass(frozen=True, slots=True)
class Speedups:
    """Which speed-ups are on. None changes the answer.

    prefixes     solve for a prefix, replay its maps, and extend it where they fail
    path_names   begin with few names for paths
    from_below   ask a longer prefix first for a map that costs what was proved for a shorter one
    names        causal theory: give the dstates names beforehand; full theory where places have frames: settle them before places and paths
    clique       with names: pin steps that are pairwise apart; with frames: let such nodes be the first at their dstates, and pin
                 stretches no two of which can be one path
    apart        with names: say which steps are apart, where more than one action shows it
    lazy         with names: give clingo only the links that replaying contradicts; with frames: of a long trace only the visits without which others are lost
    core_guided  with names or frames: raise the bound from below, rather than better the map
    small_cores  with frames: make cores smaller, as long as that is cheap
    sides        with frames: say what order and sides forbid while dstates are sought, street by street
    annealed     with names or frames: where clingo takes its time, a map near a guess, so that a small one is known
    framing      full theory where places need have no frames: where clingo takes its time, seek a map in which they have, so that a small one is known
    ways         full theory without stars: where clingo takes its time, settle dstates before places and paths, with names
    watched      with names or frames: make constraints of three literals longer, so that clasp watches two of them rather than all three
    one_by_one   with names: where that stalls, ask for numbers of dstates one by one
    threads      with names or frames: two threads, where a trace is hard and there are two processors
    processes    with frames: a guess is made in a process of its own, where there are two processors
    greedy       some map without a search, for a time limit that leaves no other; in the causal theory a small one where clingo takes its time
    """

    prefixes: bool = True
    path_names: bool = True
    from_below: bool = True
    names: bool = True
    clique: bool = True
    apart: bool = True
    lazy: bool = True
    core_guided: bool = True
    small_cores: bool = True
    sides: bool = True
    annealed: bool = True
    framing: bool = True
    ways: bool = True
    watched: bool = True
    one_by_one: bool = True
    threads: bool = True
    processes: bool = True
    greedy: bool = True

    @classmethod
    def without(cls, names: str | Iterable[str]) -> Speedups:
        """All but these. Raises SolverError."""
        off = [name for name in (names.split(",") if isinstance(names, str) else names) if name]
        for name in off:
            if name not in SPEEDUPS:
                raise SolverError(f"speedups: expected names out of {', '.join(SPEEDUPS)}, got {brief(name)}")
        return cls(**dict.fromkeys(off, False))


SPEEDUPS = tuple(f.name for f in fields(Speedups))
