"""What notebooks show of values: a heading, small tables and a picture, as HTML. All text is escaped, as views and names may hold anything.

>>> table(("view", "place"), [("<b>", 0)])
'<table><thead><tr><th>view</th><th>place</th></tr></thead><tbody><tr><td>&lt;b&gt;</td><td>0</td></tr></tbody></table>'
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape

from ssh_abduction.data.errors import printable

ROWS = 50  # So many rows of a table are shown, at most: more make a notebook slow, and nobody reads them there.
LONGEST = 80  # characters of a cell


def card(heading: str, *parts: str) -> str:
    """A heading with parts of HTML below it."""
    return f"<div><p><b>{text(heading)}</b></p>{''.join(parts)}</div>"


def paragraph(sentence: str) -> str:
    """A sentence."""
    return f"<p>{text(sentence)}</p>"


def table(head: Sequence[str], rows: Iterable[Iterable[object]], more: str = "rows") -> str:
    """A table. Of more than ROWS rows the first ones are shown, and how many `more` there are."""
    listed = list(rows)
    body = "".join(
        f"<tr>{''.join(f'<td>{text(_cut(str(cell)))}</td>' for cell in row)}</tr>"
        for row in listed[:ROWS]
    )
    left = paragraph(f"and {len(listed) - ROWS} more {more}") if len(listed) > ROWS else ""
    return f"<table><thead><tr>{''.join(f'<th>{text(name)}</th>' for name in head)}</tr></thead><tbody>{body}</tbody></table>{left}"


def folded(title: str, part: str) -> str:
    """A part that opens when its title is clicked."""
    return f"<details><summary>{text(title)}</summary>{part}</details>"


def picture(svg: str) -> str:
    """A picture, as wide as the notebook at most."""
    return svg.replace("<svg ", '<svg style="max-width:100%;height:auto" ', 1)


def text(value: str) -> str:
    """A text that HTML shows as it is."""
    return escape(printable(value))


def _cut(cell: str) -> str:
    return cell if len(cell) <= LONGEST else cell[: LONGEST - 1] + "…"
