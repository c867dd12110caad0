"""A second thread that searches for small maps while an engine searches in the first."""

from __future__ import annotations

import threading
from collections.abc import Iterator

from ssh_abduction.solver.asp.limits import LimitError, Watch
from ssh_abduction.solver.engines.nearby import Labels, NearbySearch


class Beside:
    """A search for small maps, which starts at once in its own thread.

    The threads run in parallel, as numpy and clingo release Python's lock while they work.

    Attributes:
        labels: The dstate of each node in the last map found; None before the first map.
        bound: The lower bound on dstates that the search proved; 0 until it has ended.
    """

    def __init__(self, search: NearbySearch, watch: Watch, found: Iterator[Labels]) -> None:
        self.labels: Labels | None = None
        self.bound = 0
        self._watch = watch
        self._held = [search, found]  # keeps both alive until `end` frees them
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, args=(search, found), daemon=True)
        self._thread.start()

    @property
    def running(self) -> bool:
        """Whether the thread is still running."""
        return self._thread.is_alive()

    def check(self) -> None:
        """Raise the error that ended the thread, if there was one. Limits are no errors."""
        if self._error is not None:
            raise self._error

    def end(self) -> None:
        """Stop the search, and wait until the thread has ended."""
        self._watch.interrupted = True
        self._thread.join()
        # Freeing clingo's control may take seconds, so another thread does it.
        threading.Thread(target=self._held.clear).start()

    def _run(self, search: NearbySearch, found: Iterator[Labels]) -> None:
        try:
            for labels in found:
                self.labels = labels
            self.bound = search.bound or 0
        except LimitError:
            pass
        except BaseException as error:
            self._error = error
