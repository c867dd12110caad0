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
from typing import TYPE_CHECKING, Any

import numpy as np

from ssh_abduction.data.checks import free_port
from ssh_abduction.data.errors import MapError

if TYPE_CHECKING:
    from ssh_abduction.robot_logs.log_mapper import LiveSession

PAGE = Path(__file__).with_name("live_page.html")
SEEN, BEAMS = 15.0, 180  # how far in metres the laser is drawn, and at most how many beams


class LivePage(ThreadingHTTPServer):
    """Serves the page in threads of its own, until `shutdown`.

    Args:
        port: The port to listen on; 0 for any free one.
        session: The drive that is shown.

    Raises:
        MapError: The port is in use, or may not be used.
    """

    daemon_threads = True

    def __init__(self, port: int, session: LiveSession) -> None:
        # What each path returns: a page, or plain data; None if there is nothing yet.
        self.answers: dict[str, Callable[[], Any]] = {
            "/": PAGE.read_bytes,
            "/state": lambda: _state(session),
            "/ground": lambda: session.ground,
            "/page.html": lambda: session.page,
        }
        with free_port("--page", port, MapError):
            super().__init__(("127.0.0.1", port), _PageHandler)
        threading.Thread(target=self.serve_forever, daemon=True).start()

    @property
    def url(self) -> str:
        """The address of the page."""
        return f"http://127.0.0.1:{self.server_address[1]}/"


def _state(session: LiveSession) -> dict[str, Any]:
    """The map, the robot and what was said, as plain data. The drive goes on in another thread."""
    seen, scan, told = session.seen, session.scan, session.told
    robot, trail = seen.pose if seen else None, [pose for _, pose in session.trail]
    if seen and told["places"]:  # there is a map, and the robot may be anywhere on it
        robot = seen.on_map
        trail = [at for pose in trail if (at := session.mapper.on_map(pose))]
    every = 1 + scan.laser.beams // BEAMS if scan else 1
    laser = scan.ends(robot, SEEN)[::every] if scan and robot else np.zeros((0, 2))
    return {
        **told,
        "robot": robot,
        "trail": [[round(x, 2), round(y, 2)] for x, y, _ in trail],
        "laser": np.round(laser, 2).tolist(),
        "belief": seen.belief if seen else {},
        "events": session.events,
        "maps": session.maps,
    }


class _PageHandler(BaseHTTPRequestHandler):
    server: LivePage
    timeout = 60

    def do_GET(self) -> None:
        """Send the page, or an answer."""
        hosts = [f"{name}:{self.server.server_address[1]}" for name in ("127.0.0.1", "localhost")]
        make = self.server.answers.get(self.path)
        body = make() if make and self.headers.get("Host") in hosts else None
        kind = "text/html; charset=utf-8"
        if not isinstance(body, bytes | None):
            body, kind = json.dumps(body).encode(), "application/json"
        self.send_response(HTTPStatus.NOT_FOUND if body is None else HTTPStatus.OK)
        self.send_header("Content-Type", kind)
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        self.wfile.write(body or b"")

    def log_message(self, format: str, *args: Any) -> None:
        """Log nothing."""
