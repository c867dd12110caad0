"""A server on this computer alone that answers the questions of the page: why, and what if.

Only who knows the token in its address is answered, and only where the request names this computer as its host: so no other page in the browser can ask (DNS rebinding
included), and no other computer.
"""

from __future__ import annotations

import hmac
import json
import secrets
import threading
from collections.abc import Mapping
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from ssh_abduction.errors import MapError, SSHError, brief, is_whole
from ssh_abduction.rivals.explain import explain_pair
from ssh_abduction.rivals.listing import Listing
from ssh_abduction.rivals.page.content import content_of
from ssh_abduction.rivals.page.html import html_of
from ssh_abduction.solver.search import solve
from ssh_abduction.theory.theory import Theory
from ssh_abduction.trace import Trace

LARGEST = 100_000  # bytes of a question


class PageServer(ThreadingHTTPServer):
    """Serves the page of maps, and answers its questions.

    url  where the page is, with its token

    Raises MapError where the maps are not of the trace.
    """

    daemon_threads = True

    def __init__(
        self, listing: Listing, trace: Trace, theory: Theory | None = None, *, port: int = 0, maps: int = 100, limit: float | None = 30.0
    ) -> None:
        self._trace, self._theory, self._maps, self._limit = trace, theory, maps, limit
        self._content = content_of(listing, trace, name=listing.source)
        self._token = secrets.token_urlsafe(24)
        self._one_at_a_time = threading.Lock()
        super().__init__(("127.0.0.1", port), _Handler)

    @property
    def port(self) -> int:
        return int(self.server_address[1])

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}/{self._token}/"

    def is_known(self, path: str) -> str | None:
        """What is asked for, if the token is right."""
        token, _, rest = path.partition("?")[0].lstrip("/").partition("/")
        return rest if hmac.compare_digest(token.encode(), self._token.encode()) else None

    def page(self) -> str:
        return html_of(self._content, served=True)

    def answer(self, question: str, data: Mapping[str, Any]) -> dict[str, Any]:
        """The answer to a question of the page. Raises SSHError."""
        with self._one_at_a_time:
            if question == "explain":
                first, second = self._pair(data.get("pair"))
                theory = self._assuming(data)
                return {"text": str(explain_pair(self._trace, first, second, theory, limit=self._limit))}
            if question == "solve":
                found = solve(self._trace, self._assuming(data), maps=self._maps, limit=self._limit)
                if not found.maps:
                    return {"text": found.headline}
                return {"text": found.headline, "content": content_of(found, self._trace, name=self._content["file"])}
        raise MapError(f"expected explain or solve, got {brief(question)}")

    def _assuming(self, data: Mapping[str, Any]) -> Theory:
        theory = self._theory or Theory.topological()
        for name in ("same", "different"):
            pairs = data.get(name, [])
            if not isinstance(pairs, list):
                raise MapError(f"{name}: expected pairs of steps, got {brief(pairs)}")
            theory = theory.replace(**{name: tuple(dict.fromkeys([*getattr(theory, name), *map(self._pair, pairs)]))})
        return theory

    def _pair(self, pair: Any) -> tuple[int, int]:
        last = len(self._trace) - 1
        if not isinstance(pair, list) or len(pair) != 2 or not all(is_whole(t) and 0 <= t <= last for t in pair):
            raise MapError(f"expected a pair of steps from 0 to {last}, got {brief(pair)}")
        return min(pair), max(pair)


class _Handler(BaseHTTPRequestHandler):
    server: PageServer
    server_version, sys_version = "ssh-abduction", ""
    timeout = 60

    def do_GET(self) -> None:
        if self._asked() == "":
            self._send(HTTPStatus.OK, self.server.page().encode(), "text/html; charset=utf-8")
        else:
            self._refuse()

    def do_POST(self) -> None:
        asked = self._asked()
        length = self.headers.get("Content-Length", "")
        if not asked or not length.isdecimal() or int(length) > LARGEST or self.headers.get_content_type() != "application/json":
            self._refuse()
            return
        try:
            data = json.loads(self.rfile.read(int(length)))
            if not isinstance(data, dict):
                raise MapError(f"expected an object, got {brief(data)}")
            told = self.server.answer(asked, data)
        except (SSHError, ValueError, RecursionError) as error:
            told = {"error": str(error)}
        self._send(HTTPStatus.OK, json.dumps(told).encode(), "application/json")

    def _asked(self) -> str | None:
        """What is asked for, if who asks may."""
        hosts = [f"{name}:{self.server.port}" for name in ("127.0.0.1", "localhost")]
        origin = self.headers.get("Origin")
        if self.headers.get("Host") not in hosts or (origin is not None and origin not in [f"http://{host}" for host in hosts]):
            return None
        return self.server.is_known(self.path)

    def _refuse(self) -> None:
        """An empty answer, and the connection is closed, as what follows in it was not read."""
        self.close_connection = True
        self._send(HTTPStatus.FORBIDDEN, b"", "text/plain")

    def _send(self, status: HTTPStatus, body: bytes, kind: str) -> None:
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
        """Nothing is logged, as addresses hold the token."""
