"""ssh-abduction view MAPS [TRACE]: show rival maps on one page in the browser."""

from __future__ import annotations

import argparse
import shlex
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ssh_abduction.cli.options import (
    add_maps,
    flags_of,
    output,
    trace_beside,
    trace_of_maps,
    trace_path,
    written_theory,
)
from ssh_abduction.cli.parsing import Verbs
from ssh_abduction.data.checks import a_whole_number
from ssh_abduction.data.errors import AbductionError, MapError, brief, named

if TYPE_CHECKING:
    from ssh_abduction.data.trace import Trace
    from ssh_abduction.page.content import Called
    from ssh_abduction.page.replays import Run
    from ssh_abduction.rivals.listing import Listing
    from ssh_abduction.theory.theory import Theory


def add_parser(verbs: Verbs) -> None:
    parser = verbs.add(
        "view",
        run,
        "see rival maps in the browser",
        "Show maps in the browser, on one page: what all maps share, where they differ, each "
        "map alone, two maps side by side, and what happened at each step.",
        "The page is one file that works without a network. Without --serve, it cannot ask the "
        "solver. It shows the commands for that.",
    )
    add_maps(parser)
    parser.add(
        "trace",
        "the trace that was mapped; adds actions and laser images, and is needed for --serve "
        "(default: the trace in the folder of the maps, if map wrote it, or in the file of maps, "
        "if solve -o wrote it)",
        nargs="?",
        type=trace_path,
    )
    parser.add("-o --output FILE", "write the page to this file and do not open it", type=output)
    parser.add(
        "--run RUN",
        "a second trace from the mapped world. The page replays it, with a belief about where the "
        "robot is at each step. It may be TRACE itself. Beliefs come from its views, or from the "
        "file of --belief",
        dest="followed",
        type=trace_path,
    )
    parser.add(
        "--belief FILE",
        "file with what localise --json printed for the trace of --run, or for TRACE",
    )
    parser.add(
        "--serve",
        "serve the page, on this computer only, so that it can explain why two steps are one "
        "dstate or not, and solve again with assumptions; needs the trace. Ctrl-C ends the server",
    )
    said = "with --serve, seconds for each answer (default: 30)"
    parser.add("--time-limit S", said, type=float, default=30.0)
    parser.add_setting("port N", "with --serve, the port (default: any free port)", 0, type=int)
    parser.add_setting("open", "whether to open the page in the browser (default: true)", True)


def run(options: argparse.Namespace) -> int:
    from ssh_abduction.cli.obeyed_corrections import as_corrected
    from ssh_abduction.data.corrections import beside
    from ssh_abduction.data.map_file import read_json
    from ssh_abduction.data.trace import Trace
    from ssh_abduction.page.content import Called, content_of  # loads numpy
    from ssh_abduction.page.html import Page
    from ssh_abduction.rivals.listing import Listing

    options.trace = options.trace or trace_beside(options.maps)
    trace = trace_of_maps(options.maps) if options.trace is None else Trace.load(options.trace)
    _check(options, trace)
    data = read_json(options.maps)
    source = "standard input" if options.maps == "-" else options.maps
    listing = Listing.from_dict(data, source).named_beside(options.maps)
    theory = written_theory(data)
    seen = trace
    if trace is not None and theory is not None:
        trace, theory = as_corrected(trace, theory, options.maps)
    flags = [] if theory is None else flags_of(theory, trace)
    flags += [] if trace == seen else ["--corrections", str(beside(options.maps))]
    called = Called(
        "maps.json" if options.maps == "-" else shlex.quote(options.maps),
        shlex.quote(options.trace) if options.trace else "TRACE",
        "".join(f" {shlex.quote(flag)}" for flag in flags),
    )
    localised = _run(options, trace, data)
    if options.serve:
        assert trace is not None
        return _serve(options, listing, trace, theory, localised, called)
    page = Page(content_of(listing, trace, localised, called))
    file = options.output or str(Path(tempfile.mkdtemp(prefix="ssh-abduction-")) / "maps.html")
    page.save(file)
    print(file)
    if not options.output and options.open:
        _open(Path(file).absolute().as_uri())
    return 0


def _check(options: argparse.Namespace, trace: Trace | None) -> None:
    """Raise AbductionError if the options contradict each other."""
    if options.serve and trace is None:
        raise AbductionError(
            "--serve: expected the trace that was mapped, got none; give it after the maps"
        )
    if options.serve and options.output:
        raise AbductionError(
            "--output: expected none with --serve, which writes no file; leave out one of the two"
        )
    if not 0 <= options.port <= 65535:
        raise AbductionError(f"port: expected 0 to 65535, got {options.port}; name a free port")


def _run(options: argparse.Namespace, trace: Trace | None, data: Any) -> Run | None:
    """Make the localised run that the options ask for; None if they ask for none."""
    from ssh_abduction.data.trace import Trace
    from ssh_abduction.page.replays import Run

    if options.followed is None and options.belief is None:
        return None
    followed = Trace.load(options.followed) if options.followed is not None else trace
    if followed is None:
        raise AbductionError(
            "--belief: expected the trace of the run, got none; name it with --run, or give the "
            "trace that was mapped"
        )
    if options.belief is None:
        from ssh_abduction.online.localiser import Localiser

        return Run(followed, lambda ssh_map: Localiser(ssh_map, trace=trace).beliefs(followed))
    return _with_beliefs(followed, options.belief, data)


def _with_beliefs(followed: Trace, file: str, data: Any) -> Run:
    """Make a run with the beliefs of a file that `localise --json` wrote. Raises MapError."""
    from ssh_abduction.data.map_file import read_json
    from ssh_abduction.data.maps import maps_of
    from ssh_abduction.page.replays import Run

    record = read_json(file)
    beliefs = record.get("beliefs") if isinstance(record, dict) else None
    if not isinstance(beliefs, list) or not all(isinstance(belief, dict) for belief in beliefs):
        raise MapError(
            f"{named(file)}: beliefs: expected a list of objects, got {brief(beliefs)}; write "
            "them with localise --json"
        )
    maps, number = maps_of(data, "maps"), record.get("map", 1)
    mend = "run localise with these maps"
    a_whole_number(f"{named(file)}: map", number, MapError, 1, len(maps), what="a map", mend=mend)
    if record.get("dstates", count := len(maps[number - 1].dstates)) != count:
        raise MapError(
            f"{named(file)}: dstates: expected {count}, as map {number} has, got "
            f"{brief(record['dstates'])}; run localise with these maps"
        )
    if len(beliefs) != len(followed):
        raise MapError(
            f"{named(file)}: beliefs: expected {len(followed)}, one for each step of the run, got "
            f"{len(beliefs)}; name that run with --run"
        )
    chosen, labels = maps[number - 1], maps[number - 1].renumbered().dstate_at
    visited = dict.fromkeys([*chosen.dstate_at, *range(len(chosen.dstates))])
    new = {s: i for i, s in enumerate(visited)}  # the page numbers dstates by first visit
    try:
        renumbered = [
            {**belief, "probabilities": [[new[s], p] for s, p in belief["probabilities"]]}
            for belief in beliefs
        ]
    except (KeyError, TypeError, ValueError):
        raise MapError(
            f"{named(file)}: probabilities: expected pairs [dstate, probability], got something "
            "else; localise again"
        ) from None
    return Run(followed, lambda ssh_map: renumbered if ssh_map.dstate_at == labels else None)


def _serve(
    options: argparse.Namespace,
    listing: Listing,
    trace: Trace,
    theory: Theory | None,
    localised: Run | None,
    called: Called,
) -> int:
    import signal

    from ssh_abduction.page.server import PageServer
    from ssh_abduction.runtime import program
    from ssh_abduction.solver import end_all

    where: dict[str, Any] = {"port": options.port, "time_limit": options.time_limit}
    try:
        server = PageServer(listing, trace, theory, run=localised, called=called, **where)
    except OSError as error:
        raise AbductionError(
            f"port: expected a free port, got {options.port}: {error.strerror}; name another one"
        ) from None
    with server:
        print(server.url, flush=True)
        if options.open:
            _open(server.url)
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            if program.heard[-1:] != [signal.SIGTERM]:
                program.raised.clear()  # Ctrl-C is the normal way to end the server
        finally:
            end_all()
    return 0


def _open(address: str) -> None:
    import webbrowser

    webbrowser.open(address)
