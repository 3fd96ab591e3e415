"""Collect the book's source: the pages of docs/, the repository's own papers, and reference pages made from the program.

Links between Markdown files of the repository become links between pages of the book. A broken link is an error, whether
Sphinx is installed or not.

    python docs/book/stage.py build/docs/source
"""

from __future__ import annotations

import os
import re
import shutil
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
if str(Path(__file__).parent) not in sys.path:
    sys.path.insert(0, str(Path(__file__).parent))

from case_pages import case_pages  # noqa: E402
from cli_page import cli_page  # noqa: E402
from contents import KINDS, LINK, with_indexes  # noqa: E402
from explain_page import explain_page  # noqa: E402
from form_pages import form_pages  # noqa: E402
from league import league_page  # noqa: E402
from paper_page import paper_page  # noqa: E402
from studio_page import studio_page  # noqa: E402
from troubleshooting_page import troubleshooting_page  # noqa: E402

PAPERS = {  # file of the repository: page of the book
    "README.md": "readme.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
    "SECURITY.md": "security.md",
    "benchmarks/README.md": "benchmarks.md",
}
FOLDERS = {"docs/decisions": "decisions/README.md", "docs": "index.md", "examples": "tutorials/README.md"}
FOLDERS |= {f"docs/{kind}": f"{kind}/README.md" for kind in KINDS}
GENERATED = (
    *("reference/cli.md", "reference/forms.md", "reference/faults.md", "reference/profiles.md"),
    *("reference/explanations.md", "reference/paper.md", "reference/league.md"),
    *("reference/cases/README.md", "reference/troubleshooting.md", "reference/studio-operations.md"),
)

_FENCE = re.compile(r"^(```+|~~~+)")


class BrokenLink(Exception):
    """A link to a missing file; the message has the page, the line and the target."""


def pages() -> dict[str, str]:
    """Map the files of the repository to pages of the book, both as POSIX paths."""
    found = {
        path.relative_to(ROOT).as_posix(): path.relative_to(ROOT / "docs").as_posix()
        for path in sorted((ROOT / "docs").rglob("*.md"))
        if "book" not in path.relative_to(ROOT / "docs").parts
    }
    return found | {name: page for name, page in PAPERS.items() if (ROOT / name).is_file()}


def with_links(text: str, source: str, page: str, book: dict[str, str]) -> tuple[str, dict[str, str]]:
    """Return the text of `source` as `page`, and the files that it links to or shows: file of the repository to path in the
    book."""
    beside: dict[str, str] = {}
    lines, fence = [], ""
    for number, line in enumerate(text.splitlines(keepends=True), 1):
        mark = _FENCE.match(line)
        if mark:
            fence = "" if fence and line.startswith(fence) else fence or mark[1]
        if fence or mark:
            lines.append(line)
            continue

        def turned(match: re.Match[str], number: int = number) -> str:
            target = _target(match[2], source, number, book, beside)
            if target is None:
                return match[0]
            here = os.path.relpath(target, Path(page).parent).replace(os.sep, "/")
            return f"{match[1]}{here}{match[3] or ''}{match[4]}"

        lines.append(LINK.sub(turned, line))
    return "".join(lines), beside


def _target(link: str, source: str, number: int, book: dict[str, str], beside: dict[str, str]) -> str | None:
    if re.match(r"[a-z]+:", link):
        return None
    wanted = os.path.normpath((Path(source).parent / link).as_posix()).replace(os.sep, "/")
    if wanted in book:
        return book[wanted]
    if wanted in FOLDERS:
        return FOLDERS[wanted]
    if wanted.removeprefix("docs/") in GENERATED:
        return wanted.removeprefix("docs/")
    if not (ROOT / wanted).is_file():
        raise BrokenLink(f"{source}:{number}: nothing is at {link}")
    beside[wanted] = wanted.removeprefix("docs/") if wanted.startswith("docs/") else f"files/{wanted}"
    return beside[wanted]


def generated() -> dict[str, str]:
    """Reference pages that are generated from the program itself."""
    return {
        "reference/cli.md": cli_page(),
        **form_pages(),
        "reference/explanations.md": explain_page(),
        "reference/paper.md": paper_page(),
        "reference/studio-operations.md": studio_page(),
        "reference/league.md": league_page(),
        "reference/troubleshooting.md": troubleshooting_page(),
        **case_pages(),
    }


def stage(target: Path) -> None:
    """Write the book's source to `target`, which is emptied first. Raises BrokenLink."""
    shutil.rmtree(target, ignore_errors=True)
    target.mkdir(parents=True)
    for name in ("conf.py", "book.css"):
        shutil.copy(Path(__file__).parent / name, target / name)
    book, texts = pages(), generated()
    for source, page in book.items():
        texts[page], beside = with_links((ROOT / source).read_text("utf-8"), source, page, book)
        for name, place in beside.items():
            (target / place).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, target / place)
    for page, text in with_indexes(texts, [*PAPERS.values()]).items():
        _write(target / page, text)
    left_out = shutil.ignore_patterns("__pycache__", ".*")
    shutil.copytree(ROOT / "examples", target / "files" / "examples", ignore=left_out, dirs_exist_ok=True)


def _write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, "utf-8")


if __name__ == "__main__":
    try:
        stage(Path(sys.argv[1]))
    except BrokenLink as broken:
        sys.exit(str(broken))
