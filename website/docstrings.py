"""Puts the examples of docstrings into blocks of code.

Docstrings are in Google's style, which mkdocstrings reads. In plain Markdown a paragraph that
begins with `>>>` would be a quotation.
"""

from __future__ import annotations

import re
from typing import Any

from griffe import Extension, Object

EXAMPLE = re.compile(r"^( *)>>> .*(?:\n\1.*\S.*)*", re.MULTILINE)


def with_fences(docstring: str) -> str:
    """The docstring with each example as a block of code, indented like the example."""
    return EXAMPLE.sub(lambda found: f"{found[1]}```pycon\n{found[0]}\n{found[1]}```", docstring)


class Examples(Extension):
    """Rewrites each docstring that griffe has read."""

    def on_object(self, *, obj: Object, **_: Any) -> None:
        """Fence the examples of one docstring."""
        if obj.docstring is not None:
            obj.docstring.value = with_fences(obj.docstring.value)
