"""Tables of contents of the book: the four kinds of pages, and within each kind the subjects of its README.md.

The sidebar shows one entry per subject, because a flat list of forty pages cannot be read.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

KINDS = {
    "tutorials": "Tutorials",
    "how-to": "How-to guides",
    "reference": "Reference",
    "explanation": "Explanation",
}
"""The folders of docs/, which are the four parts of the sidebar."""
LINK = re.compile(r"(\]\()([^)\s#]+)(#[^)\s]*)?(\))")
_MARK = re.compile(r"(?<=\)) \*(?![^\s,:])")
"""The mark of a generated page, which only the index page explains."""
FEWEST_PAGES = 2
"""Pages of a subject that has a page of its own. A single page is an entry of the kind itself."""


def with_indexes(texts: dict[str, str], papers: Sequence[str]) -> dict[str, str]:
    """Return all pages of the book with an index page for each kind and each subject, and with tables of contents."""
    texts = {f"{kind}/README.md": _list_of(kind, title, texts) for kind, title in KINDS.items()} | texts
    for kind in KINDS:
        texts |= _subjects(f"{kind}/README.md", texts)
    return {page: text + _contents(page, text, texts, papers) for page, text in texts.items()}


def _subjects(index: str, texts: dict[str, str]) -> dict[str, str]:
    """Return a page for each subject of an index page with its table of contents, and the index page with a table of the rest.

    A subject is a section of the index page; it has the pages to which this section links first.
    """
    folder, made, grouped, order = Path(index).parent.as_posix(), {}, set(), []
    names = _pages_of(folder, {*texts})
    for title, body in _sections(texts[index]):
        pages = [page for page in _linked(folder, body) if page in names and page not in grouped]
        grouped.update(pages)
        if not title or len(pages) < FEWEST_PAGES:
            order += pages
            continue
        page = f"{folder}/subject-{re.sub('[^a-z0-9]+', '-', title.lower()).strip('-')}.md"
        text = _MARK.sub("", body).rstrip()
        made[page] = f"# {title}\n{text}\n" + _toctree([os.path.relpath(name, folder) for name in pages])
        order.append(page)
    order += sorted(names - grouped - {index})
    made[index] = texts[index] + _toctree([os.path.relpath(name, folder) for name in order])
    return made


def _sections(text: str) -> Iterator[tuple[str, str]]:
    """Yield the heading and the text of each section of the second level. The text before the first one has no heading."""
    title, lines = "", list[str]()
    for line in text.splitlines(keepends=True):
        if line.startswith("## "):
            yield title, "".join(lines)
            title, lines = line[3:].strip(), []
        else:
            lines.append(line)
    yield title, "".join(lines)


def _pages_of(folder: str, book: set[str]) -> set[str]:
    """Return the pages of a folder; a folder below it is represented by its README.md."""
    below = {name for name in book if Path(name).parent.parent.as_posix() == folder and Path(name).name == "README.md"}
    return below | {name for name in book if Path(name).parent.as_posix() == folder}


def _linked(folder: str, text: str) -> list[str]:
    """Return the targets of links, each once, as pages of the book."""
    return [*dict.fromkeys(os.path.normpath(Path(folder, link).as_posix()) for _, link, _, _ in LINK.findall(text))]


def _contents(page: str, text: str, texts: dict[str, str], papers: Sequence[str]) -> str:
    """Return the hidden table of contents of the first page, or of the index of a folder that is not one of the kinds.

    The book's first page lists the four kinds, the decisions and the papers. The README.md of a folder lists the pages of this
    folder: first those to which it links, in that order, then all others by name.
    """
    book, folder = {*texts}, Path(page).parent.as_posix()
    if page == "index.md":
        project = ["decisions/README.md", *papers]
        first = [f"{kind}/README.md" for kind in KINDS]
        top = {name for name in book if "/" not in name or (name.count("/") == 1 and name.endswith("/README.md"))}
        others = sorted(top - {*first, *project, page})
        return _toctree([*first, *others]) + _toctree([name for name in project if name in book], "Project")
    if Path(page).name != "README.md" or folder in KINDS:
        return ""
    names = _pages_of(folder, book)
    ordered = [name for name in _linked(folder, text) if name in names]
    ordered += sorted(names - {*ordered})
    return _toctree([os.path.relpath(name, folder) for name in ordered if name != page])


def _toctree(names: list[str], caption: str = "") -> str:
    entries = [name.removesuffix(".md") for name in names]
    options = [":hidden:", *([f":caption: {caption}"] if caption else [])]
    return "\n".join(["", "```{toctree}", *options, "", *entries, "```", ""])


def _list_of(folder: str, title: str, texts: dict[str, str]) -> str:
    """Return an index page of a folder that has none: its title, and the titles of its pages."""
    lines = [f"# {title}", ""]
    for page in sorted(page for page in texts if Path(page).parent.as_posix() == folder):
        heading = next((line[2:] for line in texts[page].splitlines() if line.startswith("# ")), Path(page).stem)
        lines.append(f"- [{heading}]({Path(page).name})")
    return "\n".join([*lines, ""])
