"""The page as one HTML file: nothing is loaded from elsewhere, and no text of a trace is ever read as HTML."""

from __future__ import annotations

import base64
import hashlib
import json
import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

from ssh_abduction.data.checks import a_function
from ssh_abduction.data.errors import MapError
from ssh_abduction.data.map_file import write_map
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Trace, checked_trace
from ssh_abduction.page.content import Run, content_of
from ssh_abduction.rivals.listing import Maps

HERE = Path(__file__).parent
ESCAPED = {"<": "\\u003c", ">": "\\u003e", "&": "\\u0026", "\u2028": "\\u2028", "\u2029": "\\u2029"}


@dataclass(frozen=True, slots=True)
class Page:
    """A page about maps.

    content  all that it shows, as plain data
    """

    content: Mapping[str, Any] = field(repr=False)

    @property
    def html(self) -> str:
        """The whole page."""
        return html_of(self.content)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the page as an HTML file. Raises MapError."""
        write_map(path, self.html, "page")

    def widget(self) -> Any:
        """The page as a widget of notebooks. Raises MapError where anywidget is not installed."""
        from ssh_abduction.page.widget import widget_of

        return widget_of(self.html)


def view_page(
    source: Maps,
    trace: Trace | None = None,
    *,
    run: Trace | None = None,
    beliefs: Callable[[SSHMap], Iterable[Any] | None] | None = None,
) -> Page:
    """A page that shows maps, what they share and where they differ.

    source   a solution, or maps of one trace
    trace    the trace that was mapped, for its actions and images
    run      what the slider replays with a belief at each step; it may be the trace itself
    beliefs  where the robot of this run may have been: gives for a map the beliefs over its dstates, one for each step, as `lambda m: Localiser(m).beliefs(run)` does;
             or None, for a map in which it was not localised

    Raises MapError for maps of several traces, or of another one than this, and for beliefs without a run, or the other way round.
    """
    for given in (trace, run):
        if given is not None:
            checked_trace(given)
    if beliefs is not None:
        a_function("beliefs", beliefs, MapError, what="a function of a map")
    if (run is None) != (beliefs is None):
        raise MapError(
            "beliefs: expected a run that they are of, and beliefs for a run, got one of the two; give both, or none"
        )
    return Page(
        content_of(source, trace, None if run is None or beliefs is None else Run(run, beliefs))
    )


def html_of(content: Mapping[str, Any], *, served: bool = False) -> str:
    """The page of this content; `served` says that a server answers its questions."""
    style, script = _file("page.css"), _file("page.js")
    text = json.dumps(
        {**content, "served": served}, ensure_ascii=False, separators=(",", ":"), allow_nan=False
    )
    for character, escape in ESCAPED.items():
        text = text.replace(character, escape)
    policy = (
        f"default-src 'none'; script-src '{_digest(script)}'; style-src '{_digest(style)}'; connect-src {chr(39) + 'self' + chr(39) if served else chr(39) + 'none' + chr(39)}; "
        "base-uri 'none'; form-action 'none'"
    )
    page = _file("page.html")
    for name, value in {
        "POLICY": policy,
        "STYLE": style,
        "SCRIPT": script,
        "CONTENT": text,
    }.items():
        before, mark, after = page.partition(f"@{name}@")
        assert mark, name
        page = before + value + after
    return page


@cache
def _file(name: str) -> str:
    return (HERE / name).read_text(encoding="utf-8")


def _digest(text: str) -> str:
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
