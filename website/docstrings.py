"""Docstrings of this project as Markdown: lists of fields become definition lists, and examples become blocks of code.

A list of fields is a paragraph like this one, in which each name is followed by two spaces or more and what it means, and a meaning may go on
in lines that are indented:

    place, path  None where the theory has none
    heading      degrees, clockwise from the heading
                 of the first dstate

In plain Markdown its lines would flow together.
"""

from __future__ import annotations

import re
from typing import Any

from griffe import Extension, Object

FIELD = re.compile(r"(\S+(?:, \S+)*) {2,}(\S.*)")
NAME = re.compile(r"[A-Za-z_]\w*")


def as_markdown(docstring: str) -> str:
    return "\n\n".join(
        _paragraph(paragraph) for paragraph in re.split(r"\n\s*\n", docstring.strip("\n"))
    )


def _paragraph(paragraph: str) -> str:
    lines = paragraph.split("\n")
    if lines[0].startswith(">>> "):
        return "\n".join(("```pycon", *lines, "```"))
    if len(lines) > 1 and set(lines[1]) == {"-"}:  # a heading as numpy has them
        return f"**{lines[0]}**\n\n{_paragraph(chr(10).join(lines[2:]))}"
    fields: list[list[str]] = []
    for number, line in enumerate(lines):
        if fields and line.startswith("  "):
            fields[-1].append(line.strip())
        elif found := FIELD.fullmatch(line):
            names, meaning = found.groups()
            fields.append([NAME.sub(lambda name: f"`{name[0]}`", names) + "\n:   " + meaning])
        else:
            return "\n\n".join((*map(" ".join, fields), "\n".join(lines[number:])))
    return "\n\n".join(map(" ".join, fields))


class FieldLists(Extension):
    """Rewrites each docstring that griffe has read."""

    def on_object(self, *, obj: Object, **_: Any) -> None:
        if obj.docstring is not None:
            obj.docstring.value = as_markdown(obj.docstring.value)
