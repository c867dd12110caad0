"""ssh-abduction mcp: answer the questions of agents about maps, by the Model Context Protocol."""

from __future__ import annotations

import argparse

from ssh_abduction.cli.parsing import verb


@verb()
def run_mcp(options: argparse.Namespace) -> int:
    """Answer the questions of agents about maps.

    Serve the Model Context Protocol on standard input and output. Tools list rooms and places, find
    things by name, tell a route in words, say whether two visits were to one place, how sure that
    is and why, and plan the next experiment. Without write=true nothing is changed. No other folder
    is read or written.
    """
    from ssh_abduction.cli.agent_desk import MapDesk, server_of  # loads numpy and clingo

    server_of(MapDesk(options.folders, write=options.write)).run("stdio")
    return 0
