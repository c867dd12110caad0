"""Make the page as one HTML file, which loads no other file and never reads trace text as HTML."""

from __future__ import annotations

import base64
import hashlib
import json
import os
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

from ssh_abduction.data.checks import a_function, an_instance, needed
from ssh_abduction.data.errors import MapError
from ssh_abduction.data.files import filled
from ssh_abduction.data.map_parts import write_map
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Trace, checked_trace
from ssh_abduction.page.content import Ground, Run, Section, content_of
from ssh_abduction.rivals.listing import Maps

HERE = Path(__file__).parent
# The parts of the script, in order.
SCRIPTS = (
    "base",
    "maps",
    "camera",
    "find",
    "ground",
    "figures",
    "regions",
    "paint",
    "drives",
    "choosing",
    "replay",
    "pairs",
    "framing",
    "main",
)
# Characters in JSON that could end the script element or a line of the script.
ESCAPED = {"<": "\\u003c", ">": "\\u003e", "&": "\\u0026", "\u2028": "\\u2028", "\u2029": "\\u2029"}


CONTENT = re.compile('<script type="application/json" id="content">(.*?)</script>', re.DOTALL)


@dataclass(frozen=True, slots=True)
class Page:
    """A page that shows maps.

    Attributes:
        content: The content as a dict for JSON.
    """

    content: Mapping[str, Any] = field(repr=False)

    @property
    def html(self) -> str:
        """The text of the HTML file."""
        return html_of(self.content)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the page as an HTML file.

        Raises:
            MapError: The file cannot be written.
        """
        write_map(path, self.html, "page")

    def widget(self) -> Any:
        """Make a notebook widget that shows the page in an iframe.

        Raises:
            MapError: The package anywidget is not installed.
        """
        with needed("widget", "anywidget", "'.[notebook]' in your clone", MapError):
            import anywidget
            import traitlets
        html = traitlets.Unicode(self.html).tag(sync=True)
        members = {"_esm": _file("script/widget.js"), "html": html}
        return type("PageWidget", (anywidget.AnyWidget,), members)()


def view_page(
    source: Maps,
    trace: Trace | None = None,
    *,
    run: Trace | None = None,
    beliefs: Callable[[SSHMap], Iterable[Any] | None] | None = None,
    ground: Ground | None = None,
) -> Page:
    """Make a page that shows maps, what they share, and where they differ.

    Args:
        source: A solution, or maps of one trace.
        trace: The trace that was mapped, for its actions and images; None if it is unknown.
        run: The trace of a robot in the mapped world, which the page replays with a belief at each
            step. It may be `trace` itself. Needs `beliefs`.
        beliefs: A function that takes a map and returns the belief at each step of the run, such as
            `lambda m: Localiser(m).beliefs(run)`. It returns None for a map in which the robot was
            not localised.
        ground: What is known of the log of the maps: what the laser saw, and a report.

    Raises:
        MapError: The maps are of several traces or not of `trace`, or only one of `run` and
            `beliefs` is given.
    """
    for given in (trace, run):
        if given is not None:
            checked_trace(given)
    if beliefs is not None:
        a_function("beliefs", beliefs, MapError, what="a function of a map")
    if ground is not None:
        an_instance("ground", ground, Ground, MapError, mend="make one, or leave it out")
    if (run is None) != (beliefs is None):
        raise MapError(
            "beliefs: expected both a run and its beliefs, or neither, got one of the two; give "
            "the other one"
        )
    localised = None if run is None or beliefs is None else Run(run, beliefs)
    return Page(content_of(source, trace, localised, ground=ground))


def ground_in(file: str | os.PathLike[str], steps: int) -> Ground | None:
    """Read from a page what is known of the log of its maps; None if it is of no such log.

    `steps` is the number of steps of the trace.
    """
    try:
        found = CONTENT.search(Path(file).read_text(encoding="utf-8"))
        content = json.loads(found[1]) if found else {}
        if len(content["ground"]["spots"]) != steps:
            return None
        return Ground(content["ground"], [Section(**section) for section in content["report"]])
    except (OSError, ValueError, KeyError, TypeError):
        return None


def html_of(content: Mapping[str, Any], *, served: bool = False) -> str:
    """Make the text of the HTML file. If `served`, a server answers the questions of the page."""
    style = _file("page.css")
    script = "\n".join(_file(f"script/{name}.js") for name in SCRIPTS)
    shape: dict[str, Any] = {"ensure_ascii": False, "separators": (",", ":"), "allow_nan": False}
    text = json.dumps({**content, "served": served}, **shape)
    for character, escape in ESCAPED.items():
        text = text.replace(character, escape)
    asked = "self" if served else "none"
    policy = (
        f"default-src 'none'; script-src '{_digest(script)}'; style-src '{_digest(style)}'; "
        f"img-src data:; connect-src '{asked}'; base-uri 'none'; form-action 'none'"
    )
    return filled(HERE / "page.html", policy=policy, style=style, script=script, content=text)


@cache
def _file(name: str) -> str:
    return (HERE / name).read_text(encoding="utf-8")


def _digest(text: str) -> str:
    """Compute the digest by which a content security policy allows a script or style."""
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
