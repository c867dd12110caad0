"""ssh-abduction view MAPS [TRACE]: rival maps on one page in the browser."""

from __future__ import annotations

import argparse

from ssh_abduction.cli.options import Verbs
from ssh_abduction.errors import SSHError


def add_parser(verbs: Verbs) -> None:
    text = "Show maps in the browser, on one page: what all share, where they differ, each map, two side by side, and what happened at each step."
    parser = verbs.add_parser("view", help="see rival maps in the browser", description=text)
    parser.add_argument("maps", help="what solve --json printed, or one saved map; - for standard input")
    parser.add_argument("trace", nargs="?", help="the trace that was mapped: for its actions and laser images, and for --serve")
    parser.add_argument("-o", "--output", metavar="FILE", help="write the page to this file, and do not open it")
    serve = (
        "serve the page on this computer alone, so that it can explain, and solve again under what is assumed; needs TRACE. Ctrl-C ends it"
    )
    parser.add_argument("--serve", action="store_true", help=serve)
    parser.add_argument("--port", type=int, default=0, metavar="N", help="with --serve, the port (default: any that is free)")
    parser.add_argument("--time-limit", type=float, default=30.0, metavar="S", help="with --serve, seconds for an answer (default: 30)")
    parser.add_argument("--no-open", action="store_true", help="print where the page is, and do not open it")
    parser.set_defaults(run=run)
    parser.epilog = "The page is one file that loads nothing from elsewhere. Without --serve it says which commands answer its questions."


def run(options: argparse.Namespace) -> int:
    from ssh_abduction.maps import read_json
    from ssh_abduction.rivals.listing import Listing
    from ssh_abduction.rivals.page.content import content_of  # which loads numpy
    from ssh_abduction.rivals.page.html import Page
    from ssh_abduction.trace import Trace

    if options.serve and options.trace is None:
        raise SSHError("--serve: expected the trace that was mapped, got none; give it after the maps")
    if options.serve and options.output:
        raise SSHError("--output: expected none with --serve, which writes no file; leave out one of the two")
    if not 0 <= options.port <= 65535:
        raise SSHError(f"--port: expected 0 to 65535, got {options.port}; name a free port")
    data = read_json(options.maps)
    source = "standard input" if options.maps == "-" else options.maps
    listing = Listing.from_dict(data, source)
    trace = Trace.load(options.trace) if options.trace is not None else None
    if options.serve:
        assert trace is not None
        return _serve(listing, trace, data, options)
    page = Page(content_of(listing, trace, name=source, trace_name=options.trace or "TRACE"))
    file = options.output or _temporary()
    page.save(file)
    print(file)
    if not options.output and not options.no_open:
        _open(f"file://{file}")
    return 0


def _serve(listing: object, trace: object, data: object, options: argparse.Namespace) -> int:
    from ssh_abduction.rivals.page.server import PageServer
    from ssh_abduction.theory.theory import Theory

    theory = Theory.from_dict(data["theory"]) if isinstance(data, dict) and "theory" in data else None
    try:
        server = PageServer(listing, trace, theory, port=options.port, limit=options.time_limit)  # type: ignore[arg-type]
    except OSError as error:
        raise SSHError(f"--port: expected a free port, got {options.port}: {error.strerror}; name another one") from None
    with server:
        print(server.url, flush=True)
        if not options.no_open:
            _open(server.url)
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            return 0
    return 0


def _temporary() -> str:
    import tempfile
    from pathlib import Path

    return str(Path(tempfile.mkdtemp(prefix="ssh-abduction-")) / "maps.html")


def _open(address: str) -> None:
    import webbrowser

    webbrowser.open(address)
