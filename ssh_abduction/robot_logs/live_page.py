"""Serves a page on this computer that shows the map of a drive while it grows.

The page asks for the map each second. Only this computer may ask. `/page.html` is the page of the
last map, with all that is known of it.
"""

from __future__ import annotations

import json
import threading
from collections.abc import Callable
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from ssh_abduction.data.checks import free_port
from ssh_abduction.data.errors import MapError

PAGE = Path(__file__).with_name("live_page.html")


class LivePage(ThreadingHTTPServer):
    """Serves the page in threads of its own, until `shutdown`.

    Args:
        port: The port to listen on; 0 for any free one.
        state: A function that returns the map and the robot as plain data.
        whole: A function that returns the page of the last map; None without a map.

    Raises:
        MapError: The port is in use, or may not be used.
    """

    daemon_threads = True

    def __init__(
        self, port: int, state: Callable[[], dict[str, Any]], whole: Callable[[], bytes | None]
    ) -> None:
        self.state, self.whole = state, whole
        with free_port("--page", port, MapError):
            super().__init__(("127.0.0.1", port), _PageHandler)
        threading.Thread(target=self.serve_forever, daemon=True).start()

    @property
    def url(self) -> str:
        """The address of the page."""
        return f"http://127.0.0.1:{self.server_address[1]}/"


class _PageHandler(BaseHTTPRequestHandler):
    server: LivePage
    timeout = 60

    def do_GET(self) -> None:
        """Send the page, the state, or the page of the last map."""
        hosts = [f"{name}:{self.server.server_address[1]}" for name in ("127.0.0.1", "localhost")]
        known: dict[str, tuple[str, Callable[[], bytes | None]]] = {
            "/": ("text/html; charset=utf-8", PAGE.read_bytes),
            "/state": ("application/json", lambda: json.dumps(self.server.state()).encode()),
            "/page.html": ("text/html; charset=utf-8", self.server.whole),
        }
        kind, make = known.get(self.path, ("text/plain", lambda: None))
        body = make() if self.headers.get("Host") in hosts else None
        self.send_response(HTTPStatus.NOT_FOUND if body is None else HTTPStatus.OK)
        self.send_header("Content-Type", kind)
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        self.wfile.write(body or b"")

    def log_message(self, format: str, *args: Any) -> None:
        """Log nothing."""
