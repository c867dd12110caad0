"""Blocks of the README, docs/ and benchmarks/ print what the pages show; names in pages exist."""

from __future__ import annotations

import contextlib
import io
import os
import re
import shlex
import subprocess
import sys
import tomllib
import warnings
from dataclasses import dataclass
from functools import cache
from glob import glob
from inspect import getsource
from itertools import pairwise
from pathlib import Path

import figures
import pytest

from ssh_abduction import OnlineMapper, SSHMap
from ssh_abduction.cli import main, parser
from ssh_abduction.data.trace import Trace
from ssh_abduction.output import to_svg
from ssh_abduction.robot_logs import log_maps
from ssh_abduction.solution import Solution, Status
from ssh_abduction.solver import solve
from ssh_abduction.theory.encodings import Rules
from ssh_abduction.theory.theory import Theory

ROOT = Path(__file__).parent.parent
README = ROOT / "README.md"
TUTORIALS = sorted(
    {*(ROOT / "docs" / "tutorials").glob("*.md")} - {ROOT / "docs" / "tutorials" / "index.md"}
)
MEASURED = sorted((ROOT / "benchmarks").glob("*.md"))
PAGES = [README, *sorted((ROOT / "docs").rglob("*.md")), *MEASURED]
BLOCKS = {page: re.findall(r"```(\w*)\n(.*?)```", page.read_text(), re.DOTALL) for page in PAGES}

FILES = [
    path
    for folder in (
        "benchmarks",
        "encodings",
        "examples",
        "perception",
        "simulator",
        "ssh_abduction",
        "tests",
        "website",
    )
    for path in (ROOT / folder).rglob("*.*")
]
EXAMPLES = {
    "trace.jsonl",
    "maps.json",
    "run.json",
    "own.lp",
    "run.jsonl",
    "run.truth.json",
    "NAME.lp",
    "NAME.py",
    "compass.lp",
    "corners.lp",
    "views.jsonl",
}  # files that a reader has, or makes


CODES = {1: ": error:", 20: "unsatisfiable: ", 30: "OPTIMUM FOUND"}  # the last one is clingo's own


@dataclass(frozen=True)
class Block:
    """Lines that a page shows.

    Attributes:
        language: sh or python.
        lines: The lines.
        output: What the page says that they print; None if it does not say.
        why: Why the lines are not run; empty if they are.
    """

    language: str
    lines: str
    output: str | None
    why: str


def blocks(page: Path) -> list[Block]:
    """The blocks of a page in Python and for the shell.

    The output is the block without a language that follows.
    """
    found = re.findall(
        r"(?:<!-- not run: (.+?) -->\n)?```(\w*)\n(.*?)```", page.read_text(), re.DOTALL
    )
    return [
        Block(language, lines, output if not following else None, why)
        for (why, language, lines), (_, following, output) in pairwise([*found, ("", "end", "")])
        if language in ("sh", "python")
    ]


# Learning from images takes seconds. Tests of the learner do it, too.
LONG = {"images"}
RUN = [
    pytest.param(
        block,
        id=f"{page.stem}-{number}",
        marks=[pytest.mark.slow] if page.stem in LONG else [],
    )
    for page in PAGES
    if page not in TUTORIALS
    for number, block in enumerate(blocks(page))
    if not block.why
]


LINE = re.compile(
    r".*<<'(\w+)'\n(?:.*\n)*?\1\n|(?:.*\\\n)*.+\n"
)  # with the given text, or with the following lines


def run(block: Block) -> tuple[str, int]:
    """The output of the lines here, and the exit code."""
    with contextlib.redirect_stdout(io.StringIO()) as out:
        if block.language == "python":
            exec(block.lines, {})
            return out.getvalue(), 0
        code = 0
        if "$(" in block.lines:  # what one line leaves to the next
            code = shell(block.lines)
        else:
            for line in LINE.finditer(block.lines):
                code = run_line(line[0])
    return out.getvalue(), code


def run_line(line: str) -> int:
    """Run a line of a shell, print what it prints, and return the exit code.

    Our own command runs in this process, which saves the time to load everything.
    """
    line = line if "<<" in line else re.sub(r"\s+# .*", "", line).rstrip()
    command, pipe, reader = line.partition(" | ")
    command, _, target = command.partition(" > ")
    if not command.startswith("ssh-abduction ") or set(command) & set("$;&<\\"):
        return shell(line)
    command = " ".join(" ".join(sorted(glob(word))) or word for word in command.split(" "))
    out, code = printed_often(command) if OFTEN.fullmatch(command) else printed(command)
    if pipe:
        return shell(reader, out)
    if target:
        Path(target).write_text(out, encoding="utf-8")
    else:
        print(out, end="")
    return code


def printed(command: str) -> tuple[str, int]:
    """The output of our own command, and the exit code."""
    with contextlib.redirect_stdout(io.StringIO()) as out, warnings.catch_warnings():
        warnings.simplefilter("default")
        code = main(shlex.split(command)[1:])
    return out.getvalue(), code


# Solves an example and writes no file. Many blocks begin with the same command.
OFTEN = re.compile(r"ssh-abduction solve examples/[\w-]+\.jsonl(?: -n \d+| --json| --set \S+)*")
printed_often = cache(printed)


def shell(lines: str, given: str = "") -> int:
    """Run lines in a process, with this python; print what they print, and return the exit code."""
    lines = re.sub(
        r"(?<![\w/-])ssh-abduction(?= )", f"{shlex.quote(sys.executable)} -m ssh_abduction", lines
    )
    environment = {
        **os.environ,
        "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
    }
    done = subprocess.run(
        lines, shell=True, input=given, capture_output=True, text=True, check=False, env=environment
    )
    print(done.stdout, end="")
    return done.returncode


def without_seconds(text: str) -> str:
    """Remove from a text what depends on the speed of the machine.

    These are seconds, and the number of steps that clingo needed, because other engines take over
    after some time.
    """
    return re.sub(
        r"\d+\.\d+ s\b", "_ s", re.sub(r"\d+ of (\d+ steps given to clingo)", r"_ of \1", text)
    )


def compare(block: Block) -> None:
    output, code = run(block)
    assert code == next(
        (code for code, said in CODES.items() if said in (block.output or "")), 0
    ), block.lines
    assert block.output is None or without_seconds(output) == without_seconds(block.output)


@pytest.mark.usefixtures("without_processes")
@pytest.mark.parametrize("block", RUN)
def test_code_blocks_print_the_shown_output(
    block: Block, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    monkeypatch.chdir(tmp_path)
    compare(block)


@pytest.mark.slow
@pytest.mark.parametrize("page", TUTORIALS, ids=lambda page: page.stem)
def test_tutorials_run_in_an_empty_folder(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(log_maps, "LEAST", 1000.0)  # however slow this machine is
    monkeypatch.chdir(tmp_path)
    for block in blocks(page):
        if not block.why:
            compare(block)


def test_pages_have_enough_runnable_blocks() -> None:
    assert len(RUN) > 35


def test_shown_commands_parse() -> None:
    lines = [
        line
        for blocks in BLOCKS.values()
        for _, text in blocks
        for line in text.splitlines()
        if line.startswith("ssh-abduction ")
    ]
    assert len(lines) > 10
    for line in lines:
        words = shlex.split(re.split(r" > | \| ", line)[0], comments=True)
        assert parser().parse_args(words[1:]), line


def test_commands_page_lists_all_verbs() -> None:
    page = (ROOT / "docs" / "reference" / "commands.md").read_text()
    table = page.partition("## Verbs")[2].partition("## Options")[0]
    cells = re.findall(r"^\| (`.*?) \|", table, re.MULTILINE)
    assert set(re.findall(r"`([a-z-]+)`", " ".join(cells))) == set(parser().verbs)


def test_trace_of_the_formats_page_has_a_map(tmp_path: Path) -> None:
    written = tmp_path / "trace.jsonl"
    written.write_text(
        (ROOT / "docs" / "reference" / "formats.md").read_text().split("```")[1].lstrip()
    )
    assert solve(Trace.load(written)).status is Status.OPTIMAL


@pytest.mark.usefixtures("careful_drawings")
def test_picture_on_the_page_equals_the_drawn_map() -> None:
    (ssh_map,) = solve(Trace.load(ROOT / "examples" / "notched-rectangle.jsonl")).maps
    assert (ROOT / "docs" / "figures" / "notched-rectangle.svg").read_text() == to_svg(
        ssh_map
    ) + "\n"


@pytest.mark.usefixtures("careful_drawings")
@pytest.mark.parametrize("name", figures.DRAWN)
def test_figures_equal_the_output_of_the_program(name: str) -> None:
    assert (figures.FIGURES / f"{name}.svg").read_text() == figures.DRAWN[name]() + "\n"


def test_figures_of_how_good_stand_on_the_linked_pages() -> None:
    text = (ROOT / "docs" / "how-good.md").read_text()
    assert len(text.split()) <= 800
    rows = re.findall(r"^\| (.*) \|$", text, re.MULTILINE)[1:]
    assert len(rows) > 25
    page = ""  # a row without a link is about the page of the row above
    for row in rows:
        for name in re.findall(r"\.\./benchmarks/(\w+\.md)", row):
            page = (ROOT / "benchmarks" / name).read_text()
        assert not numbers(row) - numbers(page), row


def numbers(text: str) -> set[str]:
    """The numbers of a text, without those in the targets of links."""
    return set(re.findall(r"\d[\d.,]*\d|\d", re.sub(r"\]\([^)]*\)", "]", text)))


def test_readme_is_short_and_its_links_work_in_a_clone() -> None:
    text = README.read_text()
    assert len(text.encode()) <= 8192
    links = re.findall(r"\](?!\(https:)\(([^)]+)\)|src=\"([^\"]+)\"", text)
    assert len(links) > 5
    assert all((ROOT / "".join(link)).exists() for link in links)


def test_no_file_names_an_address_of_this_project() -> None:
    """The project has no public address yet, so each such address leads nowhere."""
    texts = [path for path in FILES if path.suffix in (".py", ".md", ".lp", ".html")]
    top = [ROOT / name for name in ("CHANGELOG.md", "CITATION.cff", "pyproject.toml")]
    address = re.compile(r"github(?:usercontent)?\.(?:com|io)/ssh-abduction")
    wrong = [path for path in (*PAGES, *texts, *top) if address.search(path.read_text())]
    assert not wrong


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_files_named_in_pages_exist(page: Path) -> None:
    text = page.read_text()
    linked = [page.parent / name for name in re.findall(r"\]\(([^)#:]+)\)", text)]
    tops = "benchmarks|docs|encodings|examples|perception|simulator|ssh_abduction|tests"
    folders = rf"(?<![\w./-])(?:{tops})/[\w./-]+\w"
    said = [ROOT / name for name in re.findall(folders, text)]
    for path in (*linked, *said):
        assert path.exists(), path
    for name in re.findall(
        r"`([\w./-]+\.(?:py|lp|jsonl?))`", text
    ):  # pages name modules from the folder that they are in on
        assert any(path.match(name) for path in FILES) or Path(name).name in EXAMPLES, name


def test_attributes_of_maps_and_solutions_named_in_pages_exist() -> None:
    types = {"solution": Solution, "ssh_map": SSHMap, "mapper": OnlineMapper, "trace": Trace}
    pages = "\n".join(page.read_text() for page in PAGES)
    found = re.findall(r"[`(](solution|ssh_map|mapper|trace)\.(?!jsonl)(\w+)", pages)
    assert len(found) > 20
    sources = {name: getsource(kind) for name, kind in types.items()}
    for name, attribute in set(found):
        made = re.search(
            rf"^    {attribute}: |self\.{attribute}\b.* = ", sources[name], re.MULTILINE
        )
        assert made or hasattr(types[name], attribute), attribute


def test_design_page_lists_the_layers_of_import_linter() -> None:
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"][
        "contracts"
    ]
    layers = next(contract["layers"] for contract in contracts if contract["type"] == "layers")
    page = (ROOT / "docs" / "explanation" / "design.md").read_text()
    floors: dict[str, set[str]] = {}
    for floor, packages in re.findall(r"^\| (\d+) \| (`.*?`) \|", page, re.MULTILINE):
        floors.setdefault(floor, set()).update(re.findall(r"`(\w+)`", packages))
    assert [*reversed(floors.values())] == [
        set(re.findall(r"(\w+)(?= \||$)", layer)) for layer in layers
    ]


def test_rule_of_the_theory_page_is_obeyed() -> None:
    (rule,) = [
        text
        for language, text in BLOCKS[ROOT / "docs" / "explanation" / "theory.md"]
        if language == "prolog"
    ]
    trace = Trace.load(ROOT / "examples" / "notched-rectangle.jsonl").prefix(24)
    assert fewest(trace, Theory.causal()) == 4
    assert fewest(trace, Theory.causal().replace(rules=[Rules("own.lp", rule)])) == 16


def fewest(trace: Trace, theory: Theory) -> int | None:
    cost = solve(trace, theory).cost
    return cost and cost.dstates


def test_names_in_contributing_exist() -> None:
    text = (ROOT / "docs" / "contributing.md").read_text()
    code = "\n".join(path.read_text() for path in FILES if path.suffix in (".py", ".lp"))
    names = set(re.findall(r"`([A-Z_]{4,}|[A-Z][a-z]+|\w+_\w+)`", text)) - {"NAME", "FIELD"}
    assert {"SURVIVE_A_CUT", "SPOKEN_FOR", "KINDS", "CASE", "Evidence"} <= names
    assert not names - set(re.findall(r"\w+", code))
