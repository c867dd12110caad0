"""Serve the page on this computer, and answer its questions.

The page asks why two steps are one dstate or not, and for the maps under the user's assumptions.
The server answers a request only if its address has the secret token and its host is this computer.
So no other computer can ask, and no other page in the browser (not even by DNS rebinding).

Each question is answered in its own process. The page closes the connection when the user asks
something else. The server then ends the process.
"""

from __future__ import annotations

import hmac
import json
import re
import secrets
import select
import socket
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from ssh_abduction.data.checks import a_list, free_port, one_of
from ssh_abduction.data.corrections import ASSERTIONS
from ssh_abduction.data.errors import AbductionError, MapError, brief, is_finite
from ssh_abduction.data.schema import FieldReader
from ssh_abduction.data.trace import Trace
from ssh_abduction.page import answers
from ssh_abduction.page.content import Called, Ground, Run, content_of
from ssh_abduction.page.html import html_of
from ssh_abduction.rivals.listing import Listing, Maps, PairInMap
from ssh_abduction.runtime.limits import LimitError, Watch, in_process
from ssh_abduction.theory.theory import Theory

LARGEST = 100_000  # bytes of a question
LENGTH = re.compile("[0-9]{1,9}")  # values of the header Content-Length
POLL = 0.1  # seconds between checks whether the connection is still open
# The process of an answer is ended after NET times its time limit plus MORE seconds. It needs time
# to start, and some of its work cannot be interrupted earlier.
NET, MORE = 1.2, 5.0


class PageServer(ThreadingHTTPServer):
    """Serves the page of maps and answers its questions.

    Args:
        listing: The maps.
        theory: Their theory; None for the topological theory.
        run: A run that the page replays with beliefs; None for none.
        called: File names and flags for the commands that the page shows; None takes the file that
            the maps come from.
        port: The port to listen on; 0 for any free one.
        max_maps: The largest number of maps in an answer; None for all.
        time_limit: Seconds for each answer; None for no limit.
        ground: What is known of the log of the maps.
        correct: A function that writes what a person says of two steps, by its kind (such as
            "elsewhere") and the steps, and returns a sentence. None if nothing can be written.
        frame: Likewise, for points that give the frame of another map: four numbers each.

    Raises:
        MapError: The maps are not of the trace, or the port is in use or may not be used.
    """

    daemon_threads = True
    request_queue_size = 128  # with Python's 5, many requests at once would wait for a minute

    def __init__(
        self,
        listing: Listing,
        trace: Trace,
        theory: Theory | None = None,
        *,
        run: Run | None = None,
        called: Called | None = None,
        port: int = 0,
        max_maps: int | None = 100,
        time_limit: float | None = 30.0,
        ground: Ground | None = None,
        correct: Callable[[str, int, int], str] | None = None,
        frame: Callable[[Sequence[Sequence[float]]], str] | None = None,
    ) -> None:
        self._trace, self._theory, self._maps, self._limit = trace, theory, max_maps, time_limit
        self._listing = listing
        self._run, self._called = run, called or Called(listing.source)
        self._ground, self._correct, self._frame = ground, correct, frame
        self.page = html_of(self._content(listing), served=True).encode()
        self._token = secrets.token_urlsafe(24)
        self._one_at_a_time = threading.Lock()
        with free_port("port", port, MapError):
            super().__init__(("127.0.0.1", port), _Handler)

    def _content(self, maps: Maps) -> dict[str, Any]:
        content = content_of(maps, self._trace, self._run, self._called, self._ground)
        return {**content, "corrects": self._correct is not None}

    @property
    def port(self) -> int:
        """The number of the port that the server listens on."""
        return int(self.server_address[1])

    @property
    def url(self) -> str:
        """The address of the page, with the secret token."""
        return f"http://127.0.0.1:{self.port}/{self._token}/"

    def is_known(self, path: str) -> str | None:
        """Return the question in the path of a request, "" for the page; None for a wrong token."""
        token, _, rest = path.partition("?")[0].lstrip("/").partition("/")
        return rest if hmac.compare_digest(token.encode(), self._token.encode()) else None

    def answer(self, question: str, data: Mapping[str, Any], watch: Watch) -> dict[str, Any]:
        """Answer "explain", why two steps are one dstate or not, "solve", "correct" or "frame".

        "solve" finds maps, "correct" writes what a person says of two steps, and "frame" writes
        `points` that are known in another map, too. `data` has `pair`, the two steps; `kind`, what
        is said of them; and `same` and `different`, lists of pairs of steps that are assumed to be
        one dstate, or different ones. The answer has `text`; and `assuming`, the cost of each
        assumption, or `content`, the new content of the page. Raises AbductionError for a malformed
        question or one without an answer, and LimitError.
        """
        written = {"correct": self._correct, "frame": self._frame}
        known = ("explain", "solve", *(name for name, writes in written.items() if writes))
        one_of("question", question, known, MapError, mend="ask one of these")
        if self._correct and question == "correct":
            kind = one_of("kind", data.get("kind"), ASSERTIONS, MapError, mend="take one of these")
            return {"text": self._correct(kind, *self._pair(data.get("pair")))}
        if self._frame and question == "frame":
            mend = "send a list such as [[0, 0, 1, 2], [5, 0, 6, 2]]"
            points = a_list("points", data.get("points"), MapError, what="points", mend=mend)
            read = FieldReader("question")
            row = read.several(read.that("a number of metres", is_finite), "four numbers", 4)
            return {"text": self._frame([row(point, "point") for point in points])}
        theory = self._assuming(data)
        pair = self._pair(data.get("pair")) if question == "explain" else None
        maps = self._listing.maps
        with self._turn(watch):
            if pair is not None:
                asked = self._trace, *pair, theory, maps, self._limit
                why = in_process(answers.pair_explained, *asked, watch=watch)
                # The maps of the page tell more, unless the user assumes more.
                as_mapped = theory == (self._theory or Theory.topological())
                said = PairInMap.of(self._listing, *pair) if as_mapped else None
                text = "\n".join(map(str, filter(None, (said, why))))
                return {"text": text, "assuming": why.assuming}
            search = self._trace, theory, maps, self._maps, self._limit
            found = in_process(answers.solved_with, *search, watch=watch)
        if not found.maps:
            return {"text": found.headline}
        return {"text": found.headline, "content": self._content(found)}

    @contextmanager
    def _turn(self, watch: Watch) -> Iterator[None]:
        """Wait until no other question is being answered, as only one is answered at a time."""
        while not self._one_at_a_time.acquire(timeout=POLL):
            watch.check()
        try:
            watch.start()  # the time of waiting does not count
            yield
        finally:
            self._one_at_a_time.release()

    @property
    def net(self) -> float | None:
        """The seconds after which the process of an answer is ended; None for no limit."""
        return None if self._limit is None else NET * self._limit + MORE

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Print an error, unless the connection was closed before the answer came."""
        if not isinstance(sys.exception(), ConnectionError):
            super().handle_error(request, client_address)

    def _assuming(self, data: Mapping[str, Any]) -> Theory:
        """Add the assumptions in a question to the theory. Raise MapError for malformed ones."""
        theory = self._theory or Theory.topological()
        for name in ("same", "different"):
            what, mend = "pairs of steps", "send a list such as [[0, 8]]"
            pairs = a_list(name, data.get(name, []), MapError, what=what, mend=mend)
            theory = theory.replace(
                **{name: tuple(dict.fromkeys([*getattr(theory, name), *map(self._pair, pairs)]))}
            )
        return theory

    def _pair(self, pair: Any) -> tuple[int, int]:
        """Check a pair of steps, and return it in order. Raise MapError if it is malformed."""
        last = len(self._trace) - 1
        read = FieldReader("question")
        read.mend, steps = "send two such as [0, 8]", f"a pair of steps from 0 to {last}"
        pair = read.several(read.within(0, last, steps), steps, 2)(pair, "pair")
        return min(pair), max(pair)


class _Handler(BaseHTTPRequestHandler):
    """Answers one request by HTTP/1.0, which closes the connection afterwards."""

    server: PageServer
    server_version, sys_version = "ssh-abduction", ""
    timeout = 60

    def do_GET(self) -> None:
        """Send the page."""
        if self._asked() == "":
            self._send(HTTPStatus.OK, self.server.page, "text/html; charset=utf-8")
        else:
            self._refuse()

    def do_POST(self) -> None:
        """Answer a question of the page."""
        asked = self._asked()
        lengths = self.headers.get_all("Content-Length", [])
        length = (
            int(lengths[0]) if len(lengths) == 1 and LENGTH.fullmatch(lengths[0]) else LARGEST + 1
        )
        if not asked or length > LARGEST or self.headers.get_content_type() != "application/json":
            self._refuse()
            return
        watch = Watch(self.server.net)
        try:
            data = json.loads(self.rfile.read(length))
            if not isinstance(data, dict):
                raise MapError(f"expected an object, got {brief(data)}; send JSON in braces")
            with _while_there(self.connection, watch):
                answer = self.server.answer(asked, data, watch)
        except LimitError as error:
            answer = {"error": f"no answer in time ({error.reason}); --time-limit gives more time"}
        except (AbductionError, ValueError, RecursionError) as error:
            answer = {"error": str(error)}
        if not watch.interrupted:
            self._send(HTTPStatus.OK, json.dumps(answer).encode(), "application/json")

    def _asked(self) -> str | None:
        """The question in the path of the request; None if the request has to be rejected."""
        hosts = [f"{name}:{self.server.port}" for name in ("127.0.0.1", "localhost")]
        origin = self.headers.get("Origin")
        if self.headers.get("Host") not in hosts or (
            origin is not None and origin not in [f"http://{host}" for host in hosts]
        ):
            return None
        return self.server.is_known(self.path)

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """Send an empty answer to a malformed request, without saying what is wrong."""
        self._refuse()

    def _refuse(self) -> None:
        """Send an empty answer with the status "forbidden"."""
        self._send(HTTPStatus.FORBIDDEN, b"", "text/plain")

    def _send(self, status: HTTPStatus, body: bytes, kind: str) -> None:
        """Send an answer, with headers that keep browsers from storing or framing it."""
        self.send_response(status)
        for name, value in {
            "Content-Type": kind,
            "Content-Length": str(len(body)),
            "Cache-Control": "no-store",
            "Referrer-Policy": "no-referrer",
            "X-Content-Type-Options": "nosniff",
            "X-Frame-Options": "DENY",
        }.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *args: Any) -> None:
        """Log nothing, because URLs contain the secret token."""


@contextmanager
def _while_there(connection: socket.socket, watch: Watch) -> Iterator[None]:
    """While the block runs, interrupt the watch if the other side closes the connection."""
    done = threading.Event()

    def look() -> None:
        while not done.wait(POLL):
            try:
                if select.select([connection], [], [], 0)[0] and not connection.recv(
                    1, socket.MSG_PEEK
                ):
                    watch.interrupted = True
                    return
            except (OSError, ValueError):  # the connection was reset, or closed on this side
                watch.interrupted = True
                return

    looking = threading.Thread(target=look, daemon=True)
    looking.start()
    try:
        yield
    finally:
        done.set()
        looking.join()
