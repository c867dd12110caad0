"""Show the page in a notebook, by the package anywidget (the extra `notebook`)."""

from __future__ import annotations

from typing import Any

from ssh_abduction.data.errors import MapError

SHOW = """
export default { render({ model, el }) {
  const frame = document.createElement("iframe");
  frame.sandbox = "allow-scripts";
  frame.style.cssText =
    "display:block;box-sizing:border-box;width:100%;height:680px;border:1px solid #8888";
  frame.title = "Maps";
  frame.srcdoc = model.get("html");
  el.append(frame);
} };
"""


def widget_of(html: str) -> Any:
    """Make a notebook widget that shows a page in an iframe. Raises MapError without anywidget."""
    try:
        import anywidget
        import traitlets
    except ImportError:
        raise MapError(
            "widget: expected anywidget, got none; "
            "install it with pip install 'ssh-abduction[notebook]'"
        ) from None
    members = {"_esm": SHOW, "html": traitlets.Unicode(html).tag(sync=True)}
    return type("PageWidget", (anywidget.AnyWidget,), members)()
