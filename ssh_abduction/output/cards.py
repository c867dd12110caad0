"""Make notebook cards of maps and traces: HTML with headings, tables and pictures.

All text is escaped, because views and names may contain any character.

>>> html_table(("view", "place"), [("<b>", 0)])
'<table><thead><tr><th>view</th><th>place</th></tr></thead><tbody><tr><td>&lt;b&gt;</td><td>0</td></tr></tbody></table>'
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from html import escape

from ssh_abduction.data.errors import printable
from ssh_abduction.data.groups import gathered
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.star import star_to_json
from ssh_abduction.data.trace import Step, Trace
from ssh_abduction.data.words import counted

# Limits of a card. A longer one makes a notebook slow, and nobody reads all of it.
ROWS = 50  # rows of a table
LONGEST = 80  # characters of a cell
STEPS = 10  # steps of a trace
DRAWN = 150  # dstates of a map that is drawn, as the layout of a larger one takes seconds


def map_card(ssh_map: SSHMap) -> str:
    """Make a card of a map as HTML: picture, faults, fit of displacements, and table of dstates."""
    from ssh_abduction.output.drawing import to_svg  # loads scipy

    parts = [paragraph(f"not drawn, as it has more than {DRAWN} dstates")]
    if len(ssh_map.dstates) <= DRAWN:
        parts = [picture(to_svg(ssh_map))]
    if ssh_map.faults:
        parts.append(paragraph("; ".join(map(str, ssh_map.faults))))
    if fit := ssh_map.fit:
        freedom = f"{fit.dof} degrees of freedom (p = {fit.p:.2g})"
        parts.append(paragraph(f"chi-square {fit.chi2:.1f} for {freedom}"))
    head, rows = table_of_dstates(ssh_map)
    dstates = folded(counted(len(rows), "dstates"), html_table(head, rows, "dstates"))
    return card(repr(ssh_map)[1:-1], *parts, dstates)


def table_of_dstates(ssh_map: SSHMap) -> tuple[tuple[str, ...], list[tuple[object, ...]]]:
    """Make the head and the rows of a table of dstates, each with its place and its links.

    A map without places has fewer columns.
    """
    leads = gathered((source, f"{action} → {target}") for source, action, target in ssh_map.links)
    columns: dict[str, list[object]] = {
        "dstate": [s.id for s in ssh_map.dstates],
        "view": [s.shown for s in ssh_map.dstates],
    }
    if any(s.place is not None for s in ssh_map.dstates):
        columns["place"] = [
            "" if s.place is None else ssh_map.numbered("place", s.place) for s in ssh_map.dstates
        ]
    if any(s.path is not None for s in ssh_map.dstates):
        columns["path"] = [s.course for s in ssh_map.dstates]
    columns["links"] = [", ".join(leads.get(s.id, ())) for s in ssh_map.dstates]
    return (*columns,), [*zip(*columns.values(), strict=True)]


def trace_card(trace: Trace) -> str:
    """Make a card of a trace as HTML: a table of its first steps without empty columns."""
    columns: dict[str, Callable[[Step], object]] = {
        "view": lambda step: "" if step.view is None else step.view,
        "image": _image,
        "star": lambda step: ", ".join(map(str, star_to_json(step.star or ()))),
        "displacement": lambda step: ", ".join(f"{x:.2f}" for x in step.displacement or ()),
        "action": lambda step: step.action.name if step.action else "",
    }
    steps = trace.steps[:STEPS]
    cells = {name: [cell(step) for step in steps] for name, cell in columns.items()}
    shown = {name: column for name, column in cells.items() if any(c != "" for c in column)}
    rows = [(t, *(column[t] for column in shown.values())) for t in range(len(steps))]
    left = len(trace) - len(steps)
    more = paragraph(f"and {counted(left, 'more steps')}") if left else ""
    return card(repr(trace)[1:-1], html_table(("step", *shown), rows), more)


def card(heading: str, *parts: str) -> str:
    """Make HTML from a heading in plain text, and parts in HTML below it."""
    return f"<div><p><b>{html_text(heading)}</b></p>{''.join(parts)}</div>"


def paragraph(sentence: str) -> str:
    """Make an HTML paragraph of plain text."""
    return f"<p>{html_text(sentence)}</p>"


def html_table(head: Sequence[str], rows: Iterable[Iterable[object]], more: str = "rows") -> str:
    """Make an HTML table, whose cells become plain text.

    It has at most ROWS rows and short cells. If rows are left out, a sentence below says how many.
    `more` is the word for rows in that sentence.
    """
    listed = list(rows)
    shown = [[*map(_cut, map(str, row))] for row in listed[:ROWS]]
    names = "".join(f"<th>{html_text(name)}</th>" for name in head)
    body = "".join(
        f"<tr>{''.join(f'<td>{html_text(cell)}</td>' for cell in row)}</tr>" for row in shown
    )
    missing = len(listed) - len(shown)
    left = paragraph(f"and {missing} more {more}") if missing else ""
    return f"<table><thead><tr>{names}</tr></thead><tbody>{body}</tbody></table>{left}"


def folded(title: str, part: str) -> str:
    """Make a section that opens when its title, as plain text, is clicked."""
    return f"<details><summary>{html_text(title)}</summary>{part}</details>"


def picture(svg: str) -> str:
    """Limit an SVG picture to the width of the notebook."""
    return svg.replace("<svg ", '<svg style="max-width:100%;height:auto" ', 1)


def html_text(value: str) -> str:
    """Escape plain text for HTML."""
    return escape(printable(value))


def _cut(cell: str) -> str:
    return cell if len(cell) <= LONGEST else cell[: LONGEST - 1] + "…"


def _image(step: Step) -> object:
    if isinstance(step.image, tuple):
        return counted(len(step.image), "numbers")
    return "" if step.image is None else step.image
