"""Are faults found? ssh-abduction beside MaxSAT, state merging and a cloned hidden Markov model.

    python benchmarks/faults.py [--only PATTERN] [--solvers PATTERN] [--seeds 20] [--first 500]
                                [--limit S] [--memory MIB] [--out RESULTS.jsonl]
    python benchmarks/faults.py --show RESULTS.jsonl

The families of cases are in fault_cases.py. Optional families run only if --only matches them. A
cell is one solver on one case, in its own process, which is ended after its CPU seconds. Its result
is a line of RESULTS.jsonl, and cells in that file are not repeated. The table is printed at the
end. With --show, only the table of a stored run is printed.

CPU seconds are counted until the answer is found and, if the solver proves answers, proven.
ssh-abduction runs twice: without and with knowledge of which kinds of faults there are. RC2 always
knows the kinds.
"""

from __future__ import annotations

import argparse
import importlib
import json
import math
import multiprocessing
import re
import resource
import signal
import statistics
import sys
from collections import Counter
from collections.abc import Hashable, Iterable, Sequence
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
from arguments import add_number, add_pattern
from cell import count_processor_time, cpu_seconds, end_after
from fault_cases import FAMILIES, PRICE, Case, Explanation
from fault_peers import PEERS
from scipy.optimize import linear_sum_assignment

from ssh_abduction import SSHMap, Theory
from ssh_abduction.solution import Progress, Status
from ssh_abduction.solver import Search

OURS, TOLD = "ssh-abduction", "ssh-abduction, told the kind"
SOLVERS = (OURS, TOLD, *PEERS)
MARGIN = 2.0  # CPU seconds beyond its limit in which our solver may return its answer.
LISTING = 10.0  # CPU seconds to list more optimal maps after the proof; they are not counted.
PATIENCE = 10  # Wall-clock seconds for each CPU second, as the machine may be busy.
AROUND = 120  # Wall-clock seconds to load programs and make the trace.
COLUMNS = (
    "family",
    "solver",
    "right",
    "among the cheapest",
    "proven",
    "faults found",
    "false",
    "labels right",
    "CPU s, median",
    "worst",
    "truth not the only cheapest",
)

Record = dict[str, Any]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    add_pattern(parser, "--only", "families")
    add_pattern(parser, "--solvers", "solvers")
    add_number(parser, "--seeds", "N", 20, "cases of each family")
    add_number(parser, "--first", "SEED", 500, "the first seed")
    add_number(parser, "--limit", "S", 60.0, "CPU seconds per cell")
    add_number(parser, "--memory", "MIB", 4096, "address space a cell has, in MiB")
    parser.add_argument("--out", type=Path, metavar="RESULTS.jsonl", help="file for the results")
    parser.add_argument(
        "--show", type=Path, metavar="RESULTS.jsonl", help="print the table of stored runs"
    )
    options = parser.parse_args()
    stored = options.show or options.out
    records: list[Record] = (
        [json.loads(line) for line in stored.read_text().splitlines()]
        if stored and stored.exists()
        else []
    )
    # Measure the cells that are not stored yet.
    if not options.show:
        done = {(record["family"], record["solver"], record["seed"]) for record in records}
        for name, family in FAMILIES.items():
            for solver in SOLVERS:
                wanted = (
                    re.search(options.only, name)
                    and re.search(options.solvers, solver)
                    and (options.only or not family.optional)
                )
                for seed in range(options.first, options.first + options.seeds) if wanted else ():
                    if (name, solver, seed) not in done:
                        record = measured(name, solver, seed, options.limit, options.memory)
                        print(json.dumps(record), file=sys.stderr, flush=True)
                        records.append(record)
                        if options.out:
                            with options.out.open("a") as file:
                                file.write(json.dumps(record) + "\n")
    print(f"{table(records)}\n\n{cheaper(records)}")
    sys.exit("\n".join(contradictions(records)) or None)


def measured(name: str, solver: str, seed: int, limit: float, memory: int) -> Record:
    """Run a solver on a case, in a process of its own.

    Args:
        name: Name of the family.
        solver: Name of the solver.
        seed: Seed of the case.
        limit: CPU seconds.
        memory: Address space in MiB.

    Returns:
        The record of the cell: status, CPU seconds, and what `judged` returns for its answer.
    """
    record = {"family": name, "solver": solver, "seed": seed, "limit": limit}
    if solver in PEERS and not PEERS[solver].installed:
        return {**record, "status": "not installed"}
    if FAMILIES[name].theory.level != "causal" and solver != OURS:
        return {**record, "status": "not applicable"}
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=work, args=(sender, name, solver, seed, limit, memory))
    process.start()
    sender.close()
    answer: Record = {}
    try:
        while receiver.poll(PATIENCE * limit + AROUND):
            answer |= receiver.recv()
        process.kill()
    except EOFError:  # the process has ended
        pass
    process.join()
    return {
        **record,
        "status": "timeout" if process.exitcode in (-signal.SIGPROF, -signal.SIGKILL) else "error",
        "cpu": limit,
        **answer,
    }


def work(sender: Connection, name: str, solver: str, seed: int, limit: float, memory: int) -> None:
    """Run a cell in this process; send the size of the case, then the result, to another one."""
    for module in PEERS[solver].modules if solver in PEERS else ():
        importlib.import_module(module)
    case = FAMILIES[name].make(seed)
    sender.send(
        {"faults": len(case.faults), "true_states": case.states, "true_tenths": true_tenths(case)}
    )
    resource.setrlimit(resource.RLIMIT_AS, (memory * 2**20, -1))
    began = cpu_seconds()
    try:
        if solver in PEERS:
            end_after(limit, signal.ITIMER_PROF)
            explanation = PEERS[solver].explain(case, limit)
            spent = round(cpu_seconds() - began, 3)
            sender.send(
                {"status": "ok", "cpu": spent, **judged(case, [explanation], PEERS[solver].proves)}
            )
        else:
            count_processor_time()
            end_after(limit + MARGIN, signal.ITIMER_PROF)
            search(
                sender, case, theory_for(case, FAMILIES[name].theory, told=solver == TOLD), limit
            )
    except Exception as error:  # any error of a program is its result
        sender.send({"status": "error", "reason": f"{type(error).__name__}: {error}"[:200]})


def search(sender: Connection, case: Case, theory: Theory, limit: float) -> None:
    """Run our search, and send its answer when it is proven.

    The answer is sent again when all optimal maps are listed. Listing may take LISTING more CPU
    seconds.
    """
    began, proven_at = cpu_seconds(), math.inf

    def on_progress(progress: Progress) -> None:
        # The first report after the proof: send the answer, and start the time for listing.
        nonlocal proven_at
        if ours.status is Status.OPTIMAL and ours.best and progress.cost and proven_at == math.inf:
            proven_at = cpu_seconds() - began
            end_after(LISTING, signal.ITIMER_PROF)
            explanations = [explained(ours.best, progress.cost.tenths)]
            sender.send(
                {
                    "status": "ok",
                    "cpu": round(proven_at, 3),
                    **judged(case, explanations, proven=True),
                }
            )

    ours = Search(case.walk.trace, theory, time_limit=limit, on_progress=on_progress)
    maps = tuple(ours)
    proven = ours.status is Status.OPTIMAL
    answer = judged(case, [explained(m, ours.cost.tenths) for m in maps if ours.cost], proven)
    spent = min(proven_at, cpu_seconds() - began)
    sender.send({"status": "ok" if proven else "timeout", "cpu": round(spent, 3), **answer})


def explained(ssh_map: SSHMap, tenths: int) -> Explanation:
    """Convert a map with its cost, in tenths of a dstate, to an explanation."""
    return Explanation(
        ssh_map.labels, frozenset((fault.step, fault.kind) for fault in ssh_map.faults), tenths
    )


def theory_for(case: Case, theory: Theory, *, told: bool) -> Theory:
    """Return the theory; if `told`, one that allows only the kinds of faults of the case."""
    return (
        theory.replace(misread=PRICE if case.wrong else 0.0, slipped=PRICE if case.jumps else 0.0)
        if told
        else theory
    )


def judged(case: Case, explanations: Sequence[Explanation], proven: bool) -> Record:
    """Compare explanations with the truth.

    Args:
        case: The case.
        explanations: The answer, and other explanations of the same cost.
        proven: Whether the answer is proven minimal.

    Returns:
        Results by name; empty without an answer.
    """
    if not explanations:
        return {}
    first = explanations[0]
    return {
        "right": first.is_true(case),
        "among": any(explanation.is_true(case) for explanation in explanations),
        "listed": len(explanations),
        "proven": proven,
        "found": len(first.faults & case.faults),
        "named": len(first.faults),
        "states": len(set(first.labels)),
        "tenths": first.tenths,
        "accuracy": accuracy(first.labels, case.walk.truth),
    }


def accuracy(labels: Sequence[int], truth: Sequence[Hashable]) -> float:
    """Compute the share of steps with the right label.

    Labels are matched with true states one to one so that the share is largest (Kuhn 1955).
    """
    votes = Counter(zip(labels, truth, strict=True))
    names, states = list(dict.fromkeys(labels)), list(dict.fromkeys(truth))
    table = np.array([[votes[name, state] for state in states] for name in names])
    rows, columns = linear_sum_assignment(table, maximize=True)
    return float(table[rows, columns].sum() / len(labels))


def true_tenths(case: Case) -> int:
    """Compute the cost of the true states and faults, in tenths of a dstate."""
    if case.misseen:
        return 10 * case.states + round(10 * PRICE) * len(case.faults)
    return Explanation.of(case.walk.trace, case.walk.truth).tenths


def contradictions(records: Iterable[Record]) -> list[str]:
    """Describe answers that are proven minimal but cost more than the truth; empty if none do."""
    return [
        f"{r['family']}, seed {r['seed']}: {r['solver']} proved {r['tenths'] / 10} to "
        f"be the least, the truth costs {r['true_tenths'] / 10}"
        for r in records
        if r.get("proven") and r["tenths"] > r["true_tenths"]
    ]


def table(records: Iterable[Record]) -> str:
    """Make a table in Markdown, with a row for each family and solver."""
    rows: dict[tuple[str, str], list[Record]] = {}
    for record in records:
        rows.setdefault((record["family"], record["solver"]), []).append(record)
    order = sorted(rows, key=lambda key: (list(FAMILIES).index(key[0]), SOLVERS.index(key[1])))
    lines = [f"| {' | '.join(COLUMNS)} |", "|---" * len(COLUMNS) + "|"]
    return "\n".join(
        lines
        + [f"| {key[0]} | {key[1]} | {' | '.join(cells(key[1], rows[key]))} |" for key in order]
    )


def cells(solver: str, records: Sequence[Record]) -> list[str]:
    """Make the cells of a row of the table, from the records of one solver and family."""
    ran = [r for r in records if r["status"] in ("ok", "timeout", "error")]
    if not ran:
        return [records[0]["status"], *["–"] * (len(COLUMNS) - 3)]

    def share(key: str) -> str:
        return f"{sum(bool(r.get(key)) for r in ran)} of {len(ran)}"

    # A solver that did not finish counts as infinitely slow, so that medians are right.
    found, faults, named = (sum(r.get(key, 0) for r in ran) for key in ("found", "faults", "named"))
    seconds = [r["cpu"] if r["status"] == "ok" else math.inf for r in ran]
    limit = max(r["limit"] for r in ran)
    broke = [r for r in ran if r["status"] == "error"]
    return [
        share("right") + (f" ({len(broke)} broke)" if broke else ""),
        share("among") if solver in (OURS, TOLD) else "–",
        share("proven") if solver not in PEERS or PEERS[solver].proves else "–",
        f"{found} of {faults}",
        f"{named - found}",
        f"{statistics.mean(r.get('accuracy', 0.0) for r in ran):.3f}",
        time_of(statistics.median(seconds), limit),
        time_of(max(seconds), limit),
        rivals(ran) if solver not in PEERS else "–",
    ]


def rivals(records: Iterable[Record]) -> str:
    """Count answers that cost less than the truth, and wrong proven answers that cost the same."""
    ended = [r for r in records if "tenths" in r]
    cheaper = sum(r["tenths"] < r["true_tenths"] for r in ended)
    ties = sum(r["proven"] and r["tenths"] == r["true_tenths"] and not r["right"] for r in ended)
    return f"{cheaper} cheaper, {ties} as cheap"


def cheaper(records: Iterable[Record]) -> str:
    """Make a table in Markdown of the cases in which our answer costs less than the truth."""
    rows = [
        f"| {r['family']} | {r['seed']} | {'yes' if r['solver'] == TOLD else 'no'} | "
        f"{r['states']} + {r['named']} = {r['tenths'] / 10} | "
        f"{r['true_states']} + {r['faults']} = {r['true_tenths'] / 10} | "
        f"{'yes' if r['proven'] else 'no'} |"
        for r in records
        if r["solver"] in (OURS, TOLD) and "tenths" in r and r["tenths"] < r["true_tenths"]
    ]
    head = (
        "| family | seed | told the kind | dstates + faults = cost found | dstates + "
        "faults = cost of the truth | proven |\n|---|---|---|---|---|---|"
    )
    return "\n".join([head, *rows])


def time_of(seconds: float, limit: float) -> str:
    """Format seconds; "> limit" for infinite ones, which mean that the time ran out."""
    return f"{seconds:.2f}" if seconds < math.inf else f"> {limit:g}"


if __name__ == "__main__":
    main()
