"""Small street maps for tests: places on a grid, streets between neighbours, a robot that drives
and sees the openings."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from ssh_abduction import Trace

HEADINGS = "NESW"
ACTIONS = {
    "T": "travel",
    "R": "right",
    "L": "left",
    "A": "around",
    "U": {"name": "up", "kind": "lift"},
    "S": {"name": "stairs", "kind": "stairs"},
}
# Options of `solve` by which short traces have maps without end.
ENDLESS = ["--set=boundary=none", "--set=path_order=partial", "--set=prefer=", "-n", "0"]
QUARTERS = {"R": 1, "A": 2, "L": 3}
Streets = dict[str, dict[str, str]]


def written(text: str, stars: Sequence[Iterable[float]] | None = None) -> Trace:
    """A trace in the notation of the tables: views and actions alternate, such as "a T b R c".

    T followed by letters is a travel of its own.
    """
    words = text.split()
    actions = [ACTIONS.get(a) or {"name": a, "kind": "travel"} for a in words[1::2]]
    return Trace.from_steps(words[0::2], actions, stars=stars)


def rectangle(actions: int, views: int = 4, turn: str = "R") -> Trace:
    """The notched rectangle after some actions: turns and travels alternate, and `views` views
    repeat."""
    kinds = [ACTIONS[turn], "travel"]
    return Trace.from_steps(
        [f"v{i % views}" for i in range(actions + 1)], [kinds[i % 2] for i in range(actions)]
    )


def streets(*edges: tuple[str, str, str]) -> Streets:
    """Streets from (place, heading, place)."""
    found: Streets = {}
    for here, heading, there in edges:
        found.setdefault(here, {})[heading] = there
        found.setdefault(there, {})[HEADINGS[(HEADINGS.index(heading) + 2) % 4]] = here
    return found


def drive(
    world: Streets, place: str, heading: str, actions: Iterable[str], stars: bool = False
) -> Trace:
    """The trace of a robot that drives through a world; its views name the openings ahead, right,
    back and left."""
    facing = HEADINGS.index(heading)
    seen: list[list[int]] = []

    def look() -> None:
        seen.append([int(HEADINGS[(facing + k) % 4] in world[place]) for k in range(4)])

    look()
    done = list(actions)
    for action in done:
        if action == "T":
            place = world[place][HEADINGS[facing]]
        else:
            facing = (facing + QUARTERS[action]) % 4
        look()
    views = ["".join(map(str, star)) for star in seen]
    return Trace.from_steps(views, [ACTIONS[a] for a in done], stars=seen if stars else None)


TWO_BLOCKS = streets(
    ("a1", "E", "a2"),
    ("a2", "E", "a3"),
    ("b1", "E", "b2"),
    ("b2", "E", "b3"),
    ("a1", "S", "b1"),
    ("a2", "S", "b2"),
    ("a3", "S", "b3"),
)
SQUARE = streets(("a", "E", "b"), ("b", "S", "c"), ("d", "E", "c"), ("a", "S", "d"))
TEE = streets(("W", "E", "J"), ("J", "E", "E"), ("J", "S", "S"))
PLUS = streets(("W", "E", "J"), ("J", "E", "E"), ("J", "S", "S"), ("N", "S", "J"))
COMB = streets(
    ("P1", "E", "P2"),
    ("P2", "E", "P3"),
    ("P3", "E", "P4"),
    ("P1", "S", "D1"),
    ("P2", "S", "D2"),
    ("P4", "S", "D3"),
)

TOURS: dict[str, tuple[Streets, str, str, str]] = {
    "two blocks": (TWO_BLOCKS, "a1", "E", "TTRTRTTRTR"),
    "two blocks, further": (TWO_BLOCKS, "a1", "E", "TRTRTRTRTTRTRTTRTR"),
    "square": (SQUARE, "a", "E", "TRTRTRTR"),
    "tee": (TEE, "W", "E", "TRTATRTATTA"),
    "plus": (PLUS, "W", "E", "TRTATRTATRTATRTA"),
    "comb": (COMB, "D1", "N", "TRTRTATRTTRTATLTTTLTA"),
}
