"""Show the maps of a trace on a page in the browser, with a server that answers its questions."""

from ssh_abduction.runtime.lazy import lazy_names

TYPE_CHECKING = False

if TYPE_CHECKING:
    from ssh_abduction.page.html import Page as Page
    from ssh_abduction.page.html import view_page as view_page

__getattr__, __dir__ = lazy_names(__name__)
