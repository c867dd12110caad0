"""ssh-abduction examples: copy the examples of the package into a folder."""

from __future__ import annotations

import argparse
from pathlib import Path

from ssh_abduction.cli.options import output
from ssh_abduction.cli.parsing import Verbs
from ssh_abduction.cli.text import counted
from ssh_abduction.data.errors import AbductionError, named
from ssh_abduction.data.files import shipped, write_file


def add_parser(verbs: Verbs) -> None:
    parser = verbs.add(
        "examples",
        run,
        "copy the examples into a folder",
        "Copy the examples of the package into a folder: traces, programs and a notebook. If a "
        "file of the same name has other content, nothing is copied.",
    )
    parser.add(
        "-o --output FOLDER", "folder to write (default: examples)", type=output, default="examples"
    )


def run(options: argparse.Namespace) -> int:
    folder = Path(options.output)
    examples = {
        folder / path.name: path.read_bytes()
        for path in sorted(shipped("examples").iterdir())
        if path.is_file()
    }
    for path, data in examples.items():
        if path.exists() and not (path.is_file() and path.read_bytes() == data):
            raise AbductionError(
                f"{named(path)}: expected no file, or the example of this name, got another one; "
                "nothing was copied: move it away, or take another folder (-o FOLDER)"
            )
    folder.mkdir(parents=True, exist_ok=True)
    for path, data in examples.items():
        write_file(path, data)
    listed = ", ".join(path.name for path in examples)
    print(f"{counted(len(examples), 'examples')} in {named(folder)}: {listed}")
    return 0
