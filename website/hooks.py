"""Adds to the site of docs/ what mkdocs does not do by itself.

The README becomes the first page, each public name gets a page, and so do the measurements in
benchmarks/. Links of all pages work in a clone, so they are relative to the files there. Links to
other files become plain text here.
"""

from __future__ import annotations

import posixpath
import re
from collections.abc import Iterator
from importlib import import_module
from inspect import getdoc, isclass
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

import ssh_abduction
from ssh_abduction import data

ROOT = Path(__file__).parent.parent

# The public names by theme: all that `ssh_abduction` exports, and what else the pages import, with
# the module that has it.
THEMES: dict[str, tuple[str, ...]] = {
    "From a trace to its maps": ("solve", "Trace", "Theory", "Solution", "SSHMap", "map_log"),
    "Is a map right?": ("check", "evaluate"),
    "Rival maps, and why": (
        "compare",
        "next_experiment",
        "explain_pair",
        "explain_trace",
        "view_page",
    ),
    "Use a map": ("route", "export_map", "Localiser", "OnlineMapper", "Explorer"),
    "Learn places from images": ("BootstrapLearner",),
    "Errors": ("AbductionError",),
    "Package data": tuple(
        f"data.{name}" for name in data.__all__ if name not in ssh_abduction.__all__
    ),
    "Package output": (
        "output.to_svg",
        "output.plot",
        "output.to_networkx",
        "output.to_pandas",
        "output.to_graphml",
        "output.to_dot",
    ),
    "Package solver": tuple(
        f"solver.{name}" for name in ("Search", "find_backbone", "find_regions", "with_regions")
    ),
    "Package solution": tuple(
        f"solution.{name}"
        for name in ("Status", "Cost", "Bound", "Certificate", "Level", "Progress", "Backbone")
    ),
    "Other packages": (
        "theory.Speedups",
        "explain.why_apart",
        "explain.explain_place",
        "rivals.Comparison",
        "rivals.difference",
        "rivals.Difference",
        "rivals.Listing",
        "rivals.Experiment",
        "rivals.joins_of_drives",
        "rivals.shared_sides",
        "evaluation.Evaluation",
        "evaluation.MapEvaluation",
        "evaluation.evaluate_visits",
        "evaluation.VisitsEvaluation",
        "online.Route",
        "online.Move",
        "online.Belief",
        "online.Chances",
        "online.Exploration",
        "page.Page",
        "perception.views.ViewClusterer",
        "perception.recognition.recogniser",
        "perception.readers.logs.read_log",
        "robot_logs.log_mapper.OnlineLogMapper",
        "robot_logs.log_mapper.solved",
        "simulator.tours.simulate",
        "simulator.world.World",
        "simulator.plans.Plan",
        "perception.errors.PerceptionError",
        "simulator.errors.SimulatorError",
    ),
}


def full(name: str) -> str:
    """The full path of a name of THEMES."""
    return (
        name
        if name.split(".", maxsplit=1)[0] in ("perception", "simulator")
        else f"ssh_abduction.{name}"
    )


def named(path: str) -> Any:
    module, _, name = path.rpartition(".")
    return getattr(import_module(module), name)


def page_of(path: str) -> str:
    """The page of a name, by its path.

    Functions and classes have separate folders, because `route` and `Route` are one file on some
    systems.
    """
    kind = "classes" if isclass(named(path)) else "functions"
    return f"reference/{kind}/{path.rpartition('.')[2]}.md"


def themes() -> dict[str, tuple[str, ...]]:
    """The full paths of the names of each theme. Exported names without a theme come last."""
    more = tuple(
        name
        for name in ssh_abduction.__all__
        if not any(name in names for names in THEMES.values())
    )
    return {
        theme: tuple(map(full, names)) for theme, names in {**THEMES, "More": more}.items() if names
    }


def on_config(config: MkDocsConfig) -> None:
    (section,) = [item["Reference"] for item in config.nav or [] if "Reference" in item]
    section.extend(
        {theme: [{path.rpartition(".")[2]: page_of(path)} for path in paths]}
        for theme, paths in themes().items()
    )


def on_files(files: Files, config: MkDocsConfig) -> None:
    for uri, content in (("index.md", home()), ("reference/index.md", index()), *reference()):
        files.append(File.generated(config, uri, content=content))
    for page in sorted((ROOT / "benchmarks").glob("*.md")):
        files.append(File.generated(config, f"benchmarks/{page.name}", content=page.read_text()))


def home() -> str:
    """The README as the first page."""
    text = (ROOT / "README.md").read_text()
    text = re.sub(r"\]\((?!\w+:)", "](../", text)
    text = re.sub(r"\.\./docs/|(?<=src=\")docs/", "", text)
    return text.replace("# ssh-abduction\n", "---\nhide: [navigation]\n---\n\n# ssh-abduction\n", 1)


def index() -> str:
    lines = [
        "# Reference",
        "",
        "Each public name has a page. Import a name without a module from `ssh_abduction`.",
        "",
    ]
    for theme, paths in themes().items():
        lines += [f"## {theme}", ""]
        for path in paths:
            shown = path.removeprefix("ssh_abduction.")
            what = (
                re.split(r"(?<=[.:])\s|\n\n", getdoc(named(path)) or "")[0]
                .replace("\n", " ")
                .rstrip(".:")
            )
            lines.append(
                f"[`{shown}`]({posixpath.relpath(page_of(path), 'reference')})\n:   {what}\n"
            )
    return "\n".join(lines)


def reference() -> Iterator[tuple[str, str]]:
    for paths in themes().values():
        for path in paths:
            yield page_of(path), f"::: {path}\n"


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    return for_the_site(markdown, page.file.src_uri)


def for_the_site(markdown: str, uri: str) -> str:
    """The text of a page with its links as the site has them.

    Links to files that are no pages or pictures of the site become plain text.

    Args:
        markdown: The text.
        uri: The path of the page: from docs/ on, or benchmarks/NAME.md.
    """
    folder = posixpath.dirname(uri if uri.startswith("benchmarks/") else f"docs/{uri}")

    def mended(link: re.Match[str]) -> str:
        target = posixpath.normpath(posixpath.join(folder, link[2]))
        if not re.match(r"docs/|benchmarks/[\w-]+\.md$", target):
            return link[1]
        target = posixpath.relpath(target.removeprefix("docs/"), posixpath.dirname(uri) or ".")
        return f"[{link[1]}]({target}{link[3]})"

    target = r"(?:\.\.|results)/[^)#\s]*|[\w-]+\.py"
    return re.sub(rf"\[([^][]*)\]\(({target})(#[^)\s]*|)\)", mended, markdown)
