"""Count lines of code and modules of each package: no docstrings, comments or blank lines.

    python benchmarks/lines.py [ROOT]

ROOT is a checkout of this project, by default this one. The script prints a table in Markdown.
"""

from __future__ import annotations

import argparse
import ast
import io
import tokenize
from collections import Counter
from pathlib import Path

PACKAGES = ("ssh_abduction", "perception", "simulator")
SPACE = {
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENDMARKER,
}
DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)


def lines_of_code(text: str) -> int:
    r"""Count the lines of a module that hold code.

    >>> lines_of_code('"A docstring."\n\n# A comment.\nx = 1  # and another\ny = [\n    x\n]\n')
    4
    """
    docstrings = {
        number
        for node in ast.walk(ast.parse(text))
        if isinstance(node, DOCUMENTED) and ast.get_docstring(node, clean=False) is not None
        for number in range(node.body[0].lineno, (node.body[0].end_lineno or 0) + 1)
    }
    code = {
        number
        for token in tokenize.generate_tokens(io.StringIO(text).readline)
        if token.type not in SPACE
        for number in range(token.start[0], token.end[0] + 1)
    }
    return len(code - docstrings)


def table(root: Path) -> str:
    """Make a table of the lines of code and the modules of each package and folder below `root`."""
    lines, modules = Counter[str](), Counter[str]()
    for path in (path for name in PACKAGES for path in (root / name).rglob("*.py")):
        parts = path.relative_to(root).parts
        # A module counts for all three packages together, for its package and for its folder.
        folder = ".".join(parts[:2]) if len(parts) > 2 else parts[0]
        for name in {"all", parts[0], folder}:
            lines[name] += lines_of_code(path.read_text(encoding="utf-8"))
            modules[name] += 1
    rows = [f"| {name} | {lines[name]:,} | {modules[name]} |" for name in sorted(lines)]
    return "\n".join(["| package | lines of code | modules |", "|---|---:|---:|", *rows])


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("root", nargs="?", type=Path, default=Path(__file__).parent.parent)
    print(table(parser.parse_args().root))


if __name__ == "__main__":
    main()
