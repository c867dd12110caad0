"""Solve the facts of a trace with the encodings, with clingo's own options and output.

The first lines of the facts say which encodings the theory needs:

ssh-abduction facts trace.jsonl > trace.lp
python run.py --project=project --opt-mode=optN -n 0 trace.lp causal.lp topological.lp \\
    boundary.lp preference.lp show.lp
"""

import sys

import clingo


class Run(clingo.Application):
    """Ground the program parts of all steps at once, and solve."""

    program_name = "ssh-abduction encodings"

    def main(self, control: clingo.Control, files: list[str]) -> None:
        for file in files:
            control.load(file)
        control.ground([("base", [])])
        # The base part has the facts of the trace, which tell the last step.
        last = max(
            (
                atom.symbol.arguments[0].number
                for atom in control.symbolic_atoms.by_signature("view", 2)
            ),
            default=-1,
        )
        if last < 0:
            sys.exit(
                "run.py: expected facts view(T,V), got none; write them with ssh-abduction facts"
            )
        control.ground(
            [
                *(("step", [clingo.Number(t)]) for t in range(last + 1)),
                ("check", [clingo.Number(last)]),
            ]
        )
        control.assign_external(clingo.Function("query", [clingo.Number(last)]), True)
        control.assign_external(clingo.Function("run_by_steps"), True)
        control.solve()


if __name__ == "__main__":
    sys.exit(clingo.clingo_main(Run(), ["--warn=none", *sys.argv[1:]]))
