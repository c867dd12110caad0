"""The base class of values that are also a sequence of their maps."""

from __future__ import annotations

from collections.abc import Iterator
from typing import overload

from ssh_abduction.data.drives import Drive, pieces_in_words
from ssh_abduction.data.errors import checked_index
from ssh_abduction.data.maps import SSHMap


class MapSequence:
    """Makes a value with the attributes `maps` and `drives` a sequence of its maps."""

    __slots__ = ()
    maps: tuple[SSHMap, ...]

    @property
    def drives(self) -> tuple[Drive, ...]:
        """The drives of the trace; empty if they are unknown."""
        raise NotImplementedError

    @property
    def joined(self) -> str:
        """Which drives the first map joins, in words; empty for one drive or without a map."""
        return pieces_in_words(self.drives, self.maps[0]) if self.maps else ""

    def __len__(self) -> int:
        """The number of maps."""
        return len(self.maps)

    def __bool__(self) -> bool:
        """True, even without a map. Ask `len` or `status` whether there are maps."""
        return True

    def __iter__(self) -> Iterator[SSHMap]:
        return iter(self.maps)

    @overload
    def __getitem__(self, index: int) -> SSHMap: ...

    @overload
    def __getitem__(self, index: slice) -> tuple[SSHMap, ...]: ...

    def __getitem__(self, index: int | slice) -> SSHMap | tuple[SSHMap, ...]:
        """The map at a position, or a tuple of maps for a slice. Raises RangeError."""
        if isinstance(index, slice):
            return self.maps[index]
        return self.maps[checked_index(index, len(self.maps), "maps")]
