"""A page in the browser that shows the maps of a trace, and its server."""

from ssh_abduction.page.html import Page, view_page

__all__ = ["Page", "view_page"]
