"""The site of docs/: links lead somewhere, and nothing is loaded from elsewhere."""

from __future__ import annotations

import re
from pathlib import Path

import check
import docstrings
import hooks
import pytest

ROOT = Path(__file__).parent.parent


def test_docstring_examples_become_blocks_of_code() -> None:
    assert docstrings.with_fences("It adds.\n\n>>> 1 + 1\n2\n\nArgs:\n    x: A number.") == (
        "It adds.\n\n```pycon\n>>> 1 + 1\n2\n```\n\nArgs:\n    x: A number."
    )
    assert docstrings.with_fences("Example:\n    >>> 1\n    1") == (
        "Example:\n    ```pycon\n    >>> 1\n    1\n    ```"
    )


@pytest.mark.parametrize(
    ("link", "shown"),
    [
        ("../encodings", "there"),
        ("../README.md#try-it", "there"),
        ("formats.md#maps", "[there](formats.md#maps)"),
        ("../benchmarks/truth.md#pairs", "[there](benchmarks/truth.md#pairs)"),
        ("../benchmarks/truth.py", "there"),
    ],
)
def test_links_to_other_files_are_plain_text(link: str, shown: str) -> None:
    assert hooks.for_the_site(f"See [there]({link}).", "contributing.md") == f"See {shown}."
    assert hooks.for_the_site("[up](../index.md)", "tutorials/logs.md") == "[up](../index.md)"
    measured = "![a](../docs/figures/a.png) [b](results/b.json) [s](starts.py) [c](logs.md)"
    assert hooks.for_the_site(measured, "benchmarks/truth.md") == (
        "![a](../figures/a.png) b s [c](logs.md)"
    )


def test_names_imported_in_pages_have_a_reference_page() -> None:
    imported = set()
    for page in (ROOT / "README.md", *(ROOT / "docs").rglob("*.md")):
        for text in re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL):
            found = re.findall(
                r"^from ((?:ssh_abduction|perception|simulator)\S*) import (.*)$",
                text,
                re.MULTILINE,
            )
            imported |= {
                f"{module}.{name.strip()}" for module, names in found for name in names.split(",")
            }
    themed = {path for paths in hooks.themes().values() for path in paths}
    ours = {
        path
        for path in imported
        if not any(hooks.named(path) is hooks.named(other) for other in themed)
    }
    assert len(imported) > 10
    assert ours == set()


SOUND = (
    '<a id="top" href="#top"></a><a href="b.html#there"></a>'
    '<link rel="stylesheet" href="s.css"><a href="https://pypi.org/"></a>'
)
BROKEN = {
    '<a href="c.html"></a>': "a.html: links c.html, which is no file of the site",
    '<a href="b.html#here"></a>': "a.html: links b.html#here, but that page has no such anchor",
    '<script src="https://unpkg.com/x.js"></script>': (
        "a.html: loads https://unpkg.com/x.js from elsewhere"
    ),
    '<link rel="stylesheet" href="//fonts.example/f.css">': (
        "a.html: loads //fonts.example/f.css from elsewhere"
    ),
    '<img src="no.png">': "a.html: loads no.png, which is no file of the site",
    '<p style="background: url(https://x.example/y.png)"></p>': (
        "a.html: loads https://x.example/y.png from elsewhere"
    ),
}


@pytest.mark.parametrize("tag", ["", *BROKEN])
def test_site_check_finds_broken_links_and_foreign_files(tag: str, tmp_path: Path) -> None:
    (tmp_path / "a.html").write_text(SOUND + tag)
    (tmp_path / "b.html").write_text('<h2 id="there"></h2>')
    (tmp_path / "s.css").write_text("p { background: url(data:image/png;base64,AA) }")
    assert list(check.problems(tmp_path)) == ([BROKEN[tag]] if tag else [])


def test_site_check_finds_style_sheets_that_load_from_elsewhere(tmp_path: Path) -> None:
    (tmp_path / "s.css").write_text(
        "@import 'https://x.example/a.css'; p { background: url(\"no.png\") }"
    )
    assert list(check.problems(tmp_path)) == [
        "s.css: loads https://x.example/a.css from elsewhere",
        "s.css: loads no.png, which is no file of the site",
    ]


def test_each_page_is_in_the_navigation_once() -> None:
    listed = re.findall(
        r"^ +- (?:.*: )?([\w/-]+\.md)$", (ROOT / "mkdocs.yml").read_text(), re.MULTILINE
    )
    made = {"index.md", "reference/index.md"}
    pages = {page.relative_to(ROOT / "docs").as_posix() for page in (ROOT / "docs").rglob("*.md")}
    pages |= {f"benchmarks/{page.name}" for page in (ROOT / "benchmarks").glob("*.md")}
    assert sorted(listed) == sorted(pages | made)
