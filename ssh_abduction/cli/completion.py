"""ssh-abduction completion SHELL: completions of verbs, options and files for a shell."""

from __future__ import annotations

import argparse
import re

from ssh_abduction.cli.parsing import Verbs
from ssh_abduction.data.checks import needed
from ssh_abduction.data.errors import AbductionError

SHELLS = ("bash", "zsh", "fish", "tcsh", "powershell")


def add_parser(verbs: Verbs) -> None:
    parser = verbs.add(
        "completion",
        run,
        "print completions for a shell",
        "Print the completion of verbs, options and files for a shell. Needs the package shtab: "
        "pip install 'ssh-abduction[completion]'.",
        'bash: eval "$(ssh-abduction completion bash)" in ~/.bashrc; zsh: write it to a file '
        "_ssh-abduction in a folder of $fpath; "
        "fish: write it to ~/.config/fish/completions/ssh-abduction.fish",
    )
    parser.add("shell", "the shell to print the script for", choices=SHELLS)


def run(options: argparse.Namespace) -> int:
    with needed("completion", "shtab", "'ssh-abduction[completion]'"):
        import shtab
    if options.shell not in shtab.SUPPORTED_SHELLS:
        raise AbductionError(
            f"completion: expected a shtab that knows {options.shell}, got {shtab.__version__}; "
            "pip install -U shtab"
        )
    from ssh_abduction.cli import parser

    top = parser()
    for one in (top, *top.verbs.values()):
        for action in one._actions:  # argparse has no public name for these
            if kind := _file_kind(action):
                action.complete = shtab.FILE if kind == "file" else shtab.DIRECTORY  # type: ignore[attr-defined]
    print(shtab.complete(top, options.shell))
    return 0


def _file_kind(action: argparse.Action) -> str | None:
    """Find out whether an argument names a "file", a "folder", or neither (None)."""
    if action.nargs == 0 or action.choices is not None:
        return None
    if not action.option_strings:
        return None if action.type in (int, float) else "file"
    named = str(action.metavar or "")
    if "FOLDER" in named:
        return "folder"
    return "file" if re.search(r"FILE|TRACE|MAPS|PNG|PAGE", named) else None
