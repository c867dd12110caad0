"""What the steps of a search weigh as work.

A unit of work is about a second of one quiet core. The weights were fitted to the processor time of
solving mazes, offices and logs of robots (`benchmarks/work.py` measures them again).
"""

from __future__ import annotations

# A conflict of clasp in a small program, what the square of the number of atoms adds to each
# conflict, and an answer of clasp, in units.
CONFLICT, CONFLICT_OF_SQUARE, ANSWER = 3e-5, 6.5e-13, 2e-3
# An iteration of a least-squares fit of poses, and what each displacement adds, in microunits.
FIT, FIT_OF_ONE = 900, 8
# An atom that clingo grounds, and a call of `@go_on` by which it asks whether to go on, in
# microunits.
ATOM, ASKED = 18, 2
