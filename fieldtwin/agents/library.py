"""The resources of an agent: shipped documentation, profiles and schemas, files of the project, and the latest report."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from fieldtwin.agents.project import read_text
from fieldtwin.agents.workplace import Workplace
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.twin.site.data_files import data_root

SCHEME = "fieldtwin://"
PROJECT = "project/"
REPORT = "report/latest"
PACKAGE = Path(__file__).resolve().parents[1]


@dataclass(frozen=True)
class Resource:
    """A text that an agent can read. `uri` names it."""

    uri: str
    title: str
    path: Path


class Library:
    """The resources of one agent."""

    def __init__(self, workplace: Workplace) -> None:
        self._work = workplace
        self._shipped = {resource.uri: resource for resource in _shipped()}

    def listed(self) -> list[tuple[str, str]]:
        """Return URI and title of all resources except the files of the project, which a tool lists."""
        latest = [(SCHEME + REPORT, "HTML report of the latest scenario")] if self._work.runner.report else []
        return [(resource.uri, resource.title) for resource in self._shipped.values()] + latest

    async def read(self, uri: str) -> str:
        """Return the text of a resource. Raises `UsageError` for an unknown one, and errors of the file."""
        place = uri.removeprefix(SCHEME)
        if uri in self._shipped:
            return await asyncio.to_thread(read_text, self._shipped[uri].path)
        if place == REPORT and self._work.runner.report is not None:
            return await asyncio.to_thread(read_text, self._work.runner.report)
        if uri.startswith(SCHEME + PROJECT):
            return await asyncio.to_thread(self._work.project.read, place.removeprefix(PROJECT))
        raise UsageError(f"no resource {uri[:120]!r}", expected=f"a listed one, or {SCHEME}{PROJECT}PATH")


def _shipped() -> Iterator[Resource]:
    root = data_root()
    for path in sorted((PACKAGE / "schemas").glob("*.schema.json")):
        kind = path.name.removesuffix(".schema.json")
        yield Resource(f"{SCHEME}schema/{kind}", f"JSON schema of a {kind} file", path)
    for path in sorted((root / "profiles" / "devices").glob("*.yaml")):
        yield Resource(f"{SCHEME}profile/{path.stem}", f"profile of the device {path.stem}", path)
    for path in sorted((root / "docs").glob("*/*.md")):  # in a checkout only; the wheel has no pages
        if path.parent.name in ("how-to", "reference", "tutorials", "explanation"):
            yield Resource(f"{SCHEME}docs/{path.parent.name}/{path.name}", _heading(path), path)


def _heading(path: Path) -> str:
    with path.open(encoding="utf-8") as file:
        return file.readline().lstrip("# ").strip()
