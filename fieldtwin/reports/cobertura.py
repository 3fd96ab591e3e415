"""Coverage of Structured Text as XML in the form of Cobertura (coverage-04.dtd), which GitLab, Jenkins and Azure DevOps read.

A file is a class, and its lines are those with a statement or a branch. Transitions between states have no place in this form.
"""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path
from xml.etree import ElementTree as ET

from fieldtwin.__about__ import __version__
from fieldtwin.plc.st.coverage.places import Coverage, Kind
from fieldtwin.reports.file import put
from fieldtwin.reports.markup import clean


def write_cobertura(coverage: Coverage, path: Path, written_ms: int) -> None:
    """Write the file. `written_ms` is the time in ms since 1970. Raises `FileInvalid` if that is not possible."""
    put(path, render_cobertura(coverage, written_ms))


def render_cobertura(coverage: Coverage, written_ms: int) -> bytes:
    """Return the content of the file, UTF-8."""
    root = ET.Element("coverage", version=f"fieldtwin {__version__}", timestamp=str(written_ms), complexity="0")
    _rates(root, coverage, counts=True)
    ET.SubElement(ET.SubElement(root, "sources"), "source").text = "."
    package = ET.SubElement(ET.SubElement(root, "packages"), "package", name="structured-text", complexity="0")
    _rates(package, coverage)
    classes = ET.SubElement(package, "classes")
    for path in coverage.paths:
        part = coverage.of(path)
        element = ET.SubElement(classes, "class", name=clean(Path(path).stem), filename=clean(path), complexity="0")
        _rates(element, part)
        ET.SubElement(element, "methods")
        _lines(ET.SubElement(element, "lines"), part)
    ET.indent(root)
    head = b'<?xml version="1.0" encoding="utf-8"?>\n'
    return head + ET.tostring(root, encoding="unicode").encode() + b"\n"


def _rates(element: ET.Element, coverage: Coverage, *, counts: bool = False) -> None:
    for name, plural, (done, every) in (
        ("line", "lines", _line_count(coverage)),
        ("branch", "branches", coverage.count(Kind.BRANCH)),
    ):
        element.set(f"{name}-rate", f"{done / every if every else 1:.4f}")
        if counts:
            element.set(f"{plural}-covered", str(done))
            element.set(f"{plural}-valid", str(every))


def _line_count(coverage: Coverage) -> tuple[int, int]:
    lines = _executed_lines(coverage)
    return sum(lines.values()), len(lines)


def _executed_lines(coverage: Coverage) -> dict[tuple[str, int], bool]:
    """Return the lines with statements; a line counts as executed if one of its statements was executed."""
    lines: dict[tuple[str, int], bool] = defaultdict(bool)
    for place, executed in coverage.executed.items():
        if place.kind is Kind.STATEMENT:
            lines[place.path, place.line] |= executed
    return lines


def _lines(parent: ET.Element, coverage: Coverage) -> None:
    branches: dict[int, list[bool]] = defaultdict(list)
    for place, executed in coverage.executed.items():
        if place.kind is Kind.BRANCH:
            branches[place.line].append(executed)
    for (_, line), executed in sorted(_executed_lines(coverage).items()):
        element = ET.SubElement(parent, "line", number=str(line), hits=str(int(executed)), branch="false")
        if of := branches.get(line):
            element.set("branch", "true")
            element.set("condition-coverage", f"{100 * sum(of) // len(of)}% ({sum(of)}/{len(of)})")
