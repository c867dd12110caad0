"""Checks the site that mkdocs built.

Links and anchors must lead somewhere, and no page may load anything from elsewhere.

    python website/check.py site

Each problem is printed on a line. The exit code is 1 if there is any.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

# Attributes whose address a browser fetches when it shows a page. Of `link` it fetches all but
# what only names another page.
FETCHED = {
    "script": ("src",),
    "img": ("src", "srcset"),
    "iframe": ("src",),
    "source": ("src", "srcset"),
    "object": ("data",),
    "link": ("href",),
}
NOT_FETCHED = {"canonical", "prev", "next", "alternate"}
FETCHED_BY_STYLE = re.compile(r"""url\(\s*["']?([^"')]+)|@import\s+["']([^"']+)""")


@dataclass
class Page(HTMLParser):
    """What a page links, what it fetches, and which anchors it has."""

    text: str
    links: list[str] = field(default_factory=list)
    fetched: list[str] = field(default_factory=list)
    anchors: set[str] = field(default_factory=set)

    def __post_init__(self) -> None:
        super().__init__()
        self.feed(self.text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        said = {name: value or "" for name, value in attrs}
        self.anchors.update(said[name] for name in ("id", "name") if name in said)
        if tag == "a" and "href" in said:
            self.links.append(said["href"])
        if tag in FETCHED and not NOT_FETCHED & set(said.get("rel", "").split()):
            self.fetched += [said[name].split()[0] for name in FETCHED[tag] if said.get(name)]
        self.fetched += addresses(said.get("style", ""))


def addresses(style: str) -> list[str]:
    """What a style sheet fetches."""
    return [one or other for one, other in FETCHED_BY_STYLE.findall(style)]


def problems(site: Path) -> Iterator[str]:
    """A sentence for each thing that is wrong with the site in this folder."""

    @cache
    def page(path: Path) -> Page:
        return Page(path.read_text(encoding="utf-8"))

    for path in sorted(site.rglob("*.html")):
        name = path.relative_to(site)
        for address in page(path).fetched:
            yield from (f"{name}: {said}" for said in fetching(address, path))
        for link in page(path).links:
            parts = urlsplit(link)
            if (
                not parts.scheme and not parts.netloc and name != Path("404.html")
            ):  # links of 404.html begin at the root of a server
                target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
                target = target / "index.html" if target.is_dir() else target
                if not target.is_file():
                    yield f"{name}: links {link}, which is no file of the site"
                elif (
                    parts.fragment
                    and target.suffix == ".html"
                    and unquote(parts.fragment) not in page(target).anchors
                ):
                    yield f"{name}: links {link}, but that page has no such anchor"
    for path in sorted(site.rglob("*.css")):
        for address in addresses(path.read_text(encoding="utf-8")):
            yield from (f"{path.relative_to(site)}: {said}" for said in fetching(address, path))


def fetching(address: str, where: Path) -> Iterator[str]:
    parts = urlsplit(address)
    if parts.scheme == "data" or (where.name == "404.html" and not parts.netloc):
        return
    if parts.scheme or parts.netloc:
        yield f"loads {address} from elsewhere"
    elif parts.path and not (where.parent / unquote(parts.path)).is_file():
        yield f"loads {address}, which is no file of the site"


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("site", type=Path, help="the folder that mkdocs built")
    site = parser.parse_args().site
    found = list(problems(site))
    print(*found, sep="\n", end="\n" if found else "")
    pages = len(list(site.rglob("*.html")))
    print(f"{site}: {pages} pages, {len(found)} problems", file=sys.stderr)
    return 1 if found or not pages else 0


if __name__ == "__main__":
    sys.exit(main())
