"""Stars: the gateways (ways out) that a robot sees at a place, each with its bearing.

>>> from ssh_abduction.data.star import Star
>>> [gateway.bearing for gateway in Star.of((1, 0, 1, 0)).gateways]
[0.0, 180.0]
>>> Star.of((0, 120, 240)).openings is None
True
>>> [frame.bearings for frame in Star.of((1, None, 1, 0)).frames]
[(0.0, 180.0), (0.0, 90.0, 180.0)]

Bearings are degrees clockwise from straight ahead, in any directions. The spread of a bearing is
how many degrees it may be off. A gateway that is seen twice has two bearings. Corrected by the
robot's turn, they may differ by at most the sum of their spreads. If all gateways are near straight
ahead, right, back or left, a star is also four openings, which the fast engines read.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import combinations, combinations_with_replacement
from typing import Any, TypeAlias

from ssh_abduction.data.checks import a_number, finite, numbers_listed, plain_number
from ssh_abduction.data.errors import TraceError, brief, is_whole

Openings: TypeAlias = tuple[bool, bool, bool, bool]
Entry: TypeAlias = "float | Gateway | None"

# How many degrees a bearing may be off by default. Two spreads are less than the difference of 90
# and 120 degrees, so junctions with these angles are different.
SPREAD = 10.0
# How many degrees a bearing may be off straight ahead, right, back or left, and still count as it.
QUARTER = 20.0
# The largest spread in degrees: a gateway that was not observed may be anywhere in a half circle.
WIDEST = 90.0
# Sums and differences of bearings are off by less than this many degrees.
ROUNDING = 1e-6
# The spread of a gateway that is closed on a drive: it may be in any direction.
CLOSED = 180
# At most this many gateways of a place change between two drives.
MOST_CLOSED = 2
# The most unobserved gateways of a star. Each may exist or not, so a star has up to 2**6 frames.
MOST_UNKNOWN = 6
_FIELDS = ("bearing", "spread", "opposite", "open")


@dataclass(frozen=True, slots=True)
class Gateway:
    """A way out of a place, as seen at one step.

    Attributes:
        bearing: The direction in degrees, clockwise from straight ahead.
        spread: How many degrees the bearing may be off.
        opposite: The index, in the star, of the gateway where the same path goes on. None means
            the gateway straight opposite, if there is one.
        open: True if the gateway exists; None if it was not observed whether it exists.
    """

    bearing: float
    spread: float = SPREAD
    opposite: int | None = None
    open: bool | None = True

    def to_json(self) -> Any:
        """Return the bearing, or a dict if other fields differ from their defaults."""
        if self == Gateway(self.bearing):
            return self.bearing
        said = {"bearing": self.bearing, "spread": self.spread}
        said |= {} if self.opposite is None else {"opposite": self.opposite}
        return said if self.open else {**said, "open": None}


@dataclass(frozen=True, slots=True)
class Frame:
    """The gateways of a place as seen at one step, without doubt about which ones exist.

    Each gateway is a slot. Slots are numbered clockwise from the gateway ahead or, if there is none
    ahead, from the first one to the right of it.
    """

    # The bearing of each slot, in degrees clockwise from straight ahead.
    bearings: tuple[float, ...]
    spreads: tuple[float, ...]  # how many degrees each bearing may be off
    # For each slot, the slot where the same path goes on; None if the star gives none.
    opposite: tuple[int | None, ...]

    @property
    def slots(self) -> int:
        """The number of gateways."""
        return len(self.bearings)

    def nth(self, turn: str | None, number: int) -> int | None:
        """Return the slot (index) of the n-th gateway on a side; None if there are fewer.

        `number` is n, from 1. With `turn` "right", gateways are counted clockwise, else
        counterclockwise. A gateway straight ahead is not counted.
        """
        beside = [k for k in range(self.slots) if not (self.faces(k) or self.is_closed(k))]
        order = beside if turn == "right" else beside[::-1]
        return order[number - 1] if number <= len(order) else None

    def faces(self, slot: int) -> bool:
        """Whether the gateway with this number (slot) is straight ahead of the robot."""
        return self._is_towards(slot, 0)

    def has_behind(self, slot: int) -> bool:
        """Whether the gateway with this slot is straight behind the robot."""
        return self._is_towards(slot, 180)

    def _is_towards(self, slot: int, way: float) -> bool:
        off = angle_between(self.bearings[slot], way)
        return off <= self.spreads[slot] + ROUNDING and not self.is_closed(slot)

    def is_closed(self, slot: int) -> bool:
        """Whether the gateway with this slot is closed on this drive, and open on another."""
        return self.spreads[slot] == CLOSED

    @property
    def with_closed(self) -> tuple[Frame, ...]:
        """This frame, and the same with up to MOST_CLOSED additional closed gateways."""
        return _with_closed(self)


@dataclass(frozen=True, slots=True)
class Star:
    """All gateways (ways out of a place) that are seen at a step.

    Attributes:
        gateways: The gateways.
    """

    gateways: tuple[Gateway, ...]

    @classmethod
    def of(cls, entries: Sequence[Entry]) -> Star:
        """Make a star from the entries that a trace has for it.

        Args:
            entries: Four of 0, 1 or None (ahead, right, back, left; None if not observed), or any
                number of bearings in degrees and Gateways.
        """
        if is_four(entries):
            quarters = [(90.0 * k, entry) for k, entry in enumerate(entries) if entry != 0]
            return cls(tuple(Gateway(way, open=True if seen else None) for way, seen in quarters))
        return cls(tuple(e if isinstance(e, Gateway) else Gateway(float(e or 0)) for e in entries))

    @property
    def openings(self) -> Openings | None:
        """Four flags: is there a gateway ahead, right, back and left? Or None.

        None in these cases: a gateway was not observed or is in none of these directions; two
        gateways are in one direction; or two gateways are declared opposite without being so.
        """
        found: dict[int, int] = {}
        for k, gateway in enumerate(self.gateways):
            slot = near_quarter(gateway.bearing)
            if slot is None or not gateway.open or found.setdefault(slot, k) != k:
                return None
        for slot, k in found.items():
            opposite = self.gateways[k].opposite
            if opposite is not None and found.get((slot + 2) % 4) != opposite:
                return None
        return 0 in found, 1 in found, 2 in found, 3 in found

    @property
    def frames(self) -> tuple[Frame, ...]:
        """All frames that the place may have: each unobserved gateway may exist or not."""
        return _frames_of(self)

    @property
    def too_near(self) -> tuple[float, float] | None:
        """The bearings of two gateways whose spreads overlap; None if there are none."""
        for a, b in combinations([gateway for gateway in self.gateways if gateway.open], 2):
            if angle_between(a.bearing, b.bearing) <= a.spread + b.spread:
                return a.bearing, b.bearing
        return None

    def frame(self, kept: list[int]) -> Frame:
        """Make a frame from the gateways with these indices."""
        of = self.gateways
        clockwise = sorted(kept, key=lambda k: (of[k].bearing + of[k].spread) % 360)
        slot = {k: i for i, k in enumerate(clockwise)}
        gateways = [of[k] for k in clockwise]
        return Frame(
            tuple(g.bearing % 360 for g in gateways),
            tuple(g.spread for g in gateways),
            tuple(None if g.opposite is None else slot.get(g.opposite) for g in gateways),
        )


@lru_cache(maxsize=2**12)
def _frames_of(star: Star) -> tuple[Frame, ...]:
    """The frames of a star, see `Star.frames`."""
    unknown = [k for k, gateway in enumerate(star.gateways) if not gateway.open]
    left_out = (
        set(some) for count in range(len(unknown), -1, -1) for some in combinations(unknown, count)
    )
    every = range(len(star.gateways))
    return tuple(dict.fromkeys(star.frame([k for k in every if k not in o]) for o in left_out))


@lru_cache(maxsize=2**12)
def _with_closed(frame: Frame) -> tuple[Frame, ...]:
    """The frames with closed gateways, see `Frame.with_closed`."""
    behind = range(max(frame.slots, 1))  # the slots after which a closed gateway may come
    return tuple(
        _inserted(frame, after)
        for count in range(MOST_CLOSED + 1)
        for after in combinations_with_replacement(behind, count)
    )


def _inserted(frame: Frame, after: Sequence[int]) -> Frame:
    """Insert a closed gateway after each of these slots of a frame."""
    order: list[int | None] = []
    for slot in range(max(frame.slots, 1)):
        order += [slot] if frame.slots else []
        order += [None] * after.count(slot)
    number = {slot: k for k, slot in enumerate(order)}
    return Frame(
        tuple(0 if k is None else frame.bearings[k] for k in order),
        tuple(CLOSED if k is None else frame.spreads[k] for k in order),
        tuple(
            None if k is None or (other := frame.opposite[k]) is None else number[other]
            for k in order
        ),
    )


def is_four(entries: Sequence[Entry]) -> bool:
    """Whether a star is written as four of 0, 1 or None.

    Such numbers cannot be bearings, because two of them would be equal.
    """
    return len(entries) == 4 and all(
        x is None or (not isinstance(x, Gateway) and x in (0, 1)) for x in entries
    )


def with_gateway(star: Sequence[Entry], bearing: float, *, is_open: bool) -> tuple[Entry, ...]:
    """Return a star with the gateway at some degrees clockwise from ahead open or closed.

    An open gateway is added if the star lacks it, and a closed one removed. Raises TraceError
    if the star has only four directions, and this is none of them.
    """
    if is_four(star):
        quarter = near_quarter(bearing)
        if quarter is None:
            raise TraceError(
                "star: expected a gateway at 0, 90, 180 or 270 degrees from ahead, as the star has "
                f"four directions, got {bearing:g} degrees; name one of these"
            )
        return (*star[:quarter], int(is_open), *star[quarter + 1 :])
    entries = [e if isinstance(e, Gateway) else Gateway(float(e or 0)) for e in star]
    off = [angle_between(e.bearing, bearing) for e in entries]
    nearest = min(range(len(off)), key=off.__getitem__, default=None)
    if nearest is None or off[nearest] > max(entries[nearest].spread, QUARTER):
        return (*star, bearing % 360) if is_open else tuple(star)
    if is_open:
        known = star[nearest]
        changed = replace(known, open=True) if isinstance(known, Gateway) else known
        return (*star[:nearest], changed, *star[nearest + 1 :])
    return tuple(_without(entry, nearest) for i, entry in enumerate(star) if i != nearest)


def _without(entry: Entry, removed: int) -> Entry:
    """Return an entry of a star from which the entry with some index was removed."""
    if not isinstance(entry, Gateway) or entry.opposite is None or entry.opposite < removed:
        return entry
    return replace(entry, opposite=None if entry.opposite == removed else entry.opposite - 1)


def angle_between(a: float, b: float) -> float:
    """Return the angle between two bearings, 0 to 180 degrees."""
    return abs((a - b + 180) % 360 - 180)


def near_quarter(bearing: float) -> int | None:
    """Return 0 for a bearing near straight ahead, 1 right, 2 back, 3 left; None for all others."""
    quarter = round(bearing / 90)
    return quarter % 4 if abs(bearing - 90 * quarter) <= QUARTER else None


def parse_star(value: Any, where: str) -> tuple[Entry, ...]:
    """Return a star as a tuple of four of 0, 1 or None, or of bearings in degrees and Gateways.

    Raises TraceError, which names the value `where`.
    """
    if hasattr(value, "tolist"):
        value = value.tolist()  # numpy's
    given = [int(x) if isinstance(x, bool) else x for x in numbers_listed(value, where)]
    four = len(given) == 4 and all(
        x is None or x in (0, 1) for x in given if not isinstance(x, Mapping | Gateway)
    )
    star = tuple(_entry(x, len(given), four, f"{where}[{i}]") for i, x in enumerate(given))
    seen = [e for e in star if (e.open if isinstance(e, Gateway) else e is not None)]
    bearings = {(e.bearing if isinstance(e, Gateway) else float(e or 0)) % 360 for e in seen}
    if not is_four(star) and len(bearings) < len(seen):
        raise TraceError(
            f"{where}: expected four 0/1 (openings ahead, right, back, left) or different bearings "
            f"in degrees, got {brief(list(value))}; mend it"
        )
    for i, entry in enumerate(star):
        _check_opposite(i, entry, star, f"{where}[{i}]")
    if len(star) - len(seen) > MOST_UNKNOWN:
        raise TraceError(
            f"{where}: expected at most {MOST_UNKNOWN} gateways that were not observed, got more; "
            f"leave some out"
        )
    return star


def star_to_json(star: Sequence[Entry]) -> list[Any]:
    """Return a star as a list, as a trace file has it."""
    return [entry.to_json() if isinstance(entry, Gateway) else entry for entry in star]


def _entry(value: Any, count: int, four: bool, where: str) -> Entry:
    """Check and return one of `count` entries of a star; 0, 1 or None is allowed if `four`."""
    if isinstance(value, Gateway):
        value = {name: getattr(value, name) for name in _FIELDS}
    if isinstance(value, Mapping):
        return _gateway(value, count, where)
    if value is None and four:
        return None
    finite(value, where)
    return plain_number(value)


def _gateway(value: Mapping[str, Any], count: int, where: str) -> Gateway | float:
    """Check a gateway that is given as an object. Return its bearing if that says everything."""
    if unknown := [name for name in value if name not in _FIELDS]:
        raise TraceError(
            f"{where}: expected fields out of {', '.join(_FIELDS)}, got {brief(unknown[0])}; "
            f"leave it out"
        )
    bearing, spread, opposite, is_open = (
        value.get(name, default)
        for name, default in zip(_FIELDS, (None, SPREAD, None, True), strict=True)
    )
    mend = "say in which direction the gateway is"
    a_number(f"{where}.bearing", bearing, TraceError, what="a number of degrees", mend=mend)
    if is_open is not None and is_open is not True:
        raise TraceError(
            f"{where}.open: expected true, or null where it was not observed, "
            f"got {brief(is_open)}; leave out what is closed"
        )
    # The bearing of an observed gateway is known better.
    widest = WIDEST if is_open is None else WIDEST / 2
    mend = "say how far the bearing may be off"
    a_number(f"{where}.spread", spread, TraceError, 0, widest, what="degrees", mend=mend)
    if opposite is not None and not (is_whole(opposite) and 0 <= opposite < count):
        raise TraceError(
            f"{where}.opposite: expected the index of a gateway, 0 to {count - 1}, "
            f"got {brief(opposite)}; count from 0"
        )
    gateway = Gateway(
        float(bearing), float(spread), None if opposite is None else int(opposite), is_open
    )
    return gateway.bearing if gateway == Gateway(gateway.bearing) else gateway


def _check_opposite(i: int, entry: Entry, star: Sequence[Entry], where: str) -> None:
    """Check the field `opposite` of entry i. The opposite of that entry must be None or i."""
    if not isinstance(entry, Gateway) or entry.opposite is None:
        return
    other = star[entry.opposite]
    back = other.opposite if isinstance(other, Gateway) else None
    if entry.opposite == i or back not in (None, i):
        raise TraceError(
            f"{where}.opposite: expected another gateway, whose opposite is this one, "
            f"got {entry.opposite}; pair each gateway with one other"
        )
