"""Generate a page for each entry of the test-case lists, from the cases in the code, the test vectors and the league's
results.

Page and anchors do not change as long as the IDs do not: ``reference/cases/mb-015.html#mb-015a``. Reports and
`fieldtwin explain` link to them (`fieldtwin.book`).
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Iterator, Sequence
from functools import cache
from typing import Any

from league import ROOT, WIRES, Row, link, rows

from fieldtwin.conformance.core.case import About
from fieldtwin.explain.cases import LISTS, WEIGHT, spelled_out

VECTORS = ROOT / "tests/vectors"
EXAMPLES = 3
"""Examples of bytes for each role, from the vectors."""
LEAGUE = {
    "modbus": "modbus-devices",
    "canopen": "canopen-devices",
    "modbus-client": "modbus-clients",
    "canopen-master": "canopen-clients",
}
"""The kind of the league's entries that a command of `fieldtwin check` tests."""


def case_pages() -> dict[str, str]:
    """Return Markdown by path in the book: an index and a page for each entry."""
    entries: dict[str, list[tuple[str, str, About]]] = {}
    for command, tested, cases in LISTS:
        for case in cases:
            entries.setdefault(case.row, []).append((command, tested, case))
    pages = {f"reference/cases/{row.lower()}.md": _page(row, of) for row, of in sorted(entries.items())}
    return {"reference/cases/README.md": _index(), **pages}


def _index() -> str:
    parts = [
        "# Test cases\n",
        "`fieldtwin check` runs these cases. A case's page has the bytes, the correct behaviour, the clause, and the results"
        " of third-party stacks. [How conformance tests judge](../../explanation/conformance.md) explains basis, impact level"
        " and verdicts, and [the league](../league.md) has the results by stack.\n",
    ]
    for command, tested, cases in LISTS:
        parts.append(f"## fieldtwin check {command}: {tested}\n")
        parts.append("| case | basis | impact | what fieldtwin does | correct | source |\n|---|---|---|---|---|---|")
        for case in sorted(cases, key=lambda case: case.id):
            does = case.does or "only listens"
            parts.append(
                f"| {link(case.id, '')} {case.title} | {case.bases} | {case.impact.value} | {does} "
                f"| {case.must or 'go on'} | {case.sources} |"
            )
        parts.append("")
    return "\n".join(parts)


def _page(row: str, of: Sequence[tuple[str, str, About]]) -> str:
    titles = list(dict.fromkeys(case.title for _, _, case in of))
    parts = [f"({row.lower()})=" if all(case.id != row for _, _, case in of) else "", f"# {row}: {'; '.join(titles)}\n"]
    seen: set[str] = set()
    for command, tested, case in of:
        if case.id not in seen:
            parts.append(f"({case.id.lower()})=")
            seen.add(case.id)
        parts += _case(command, tested, case)
    examples = [*_client_bytes(row), *_device_bytes(row)]
    if examples:
        parts.append("## Examples of the bytes\n")
        parts.append("From the test vectors of this project, with the bytes of its own client or device.\n")
        parts += examples
    return "\n".join(filter(None, parts)) + "\n"


def _case(command: str, tested: str, case: About) -> Iterator[str]:
    sent = "fieldtwin" if case.role != "device" else "fieldtwin sends"
    does = case.does or "only listens"
    yield f"## {case.id}: {tested}, {case.title}\n"
    yield f"- **What happens:** {sent}{':' if case.role == 'device' else ''} {does}"
    yield f"- **Correct:** {case.must or 'go on'}"
    yield f"- **Source:** {spelled_out(case.sources)}"
    yield f"- **Basis:** {case.bases}. {WEIGHT[case.basis]}"
    yield f"- **Impact level:** {case.impact.value}"
    yield f"- **Run it alone:** `fieldtwin check {command} ... --only {case.id}`\n"
    yield from _results(LEAGUE[command], case.id)


def _results(kind: str, id: str) -> Iterator[str]:
    """Return the results of third-party stacks with the evidence of each failure."""
    tested = [row for row in _league() if row.kind == kind]
    passed = [row.title for row in tested if id in row.passed]
    open_ = [row.title for row in tested if id in row.inconclusive]
    failed = [(row, f) for row in tested for f in row.failed if f.id == id]
    of = len(passed) + len(open_) + len(failed)
    yield f"**Third-party stacks** ([the league](../league.md)): {len(passed)} of {of} rows pass.\n"
    for row, failure in failed:
        verdict = "fails" if failure.confirmed else "failure, unconfirmed"
        yield f"{row.title}: **{verdict}**: {_plain(failure.reason)}.\n"
        lines = [f"without fieldtwin: {part}" for part in failure.sent.split("; ") if part]
        lines += [f"observed: {failure.observed}"] if failure.observed else []
        yield "\n".join(["```text", *failure.frames, *lines, "```", ""])
    if passed and failed:
        yield f"Pass: {'; '.join(passed)}.\n"
    if open_:
        yield f"Inconclusive: {'; '.join(open_)}.\n"


def _plain(text: str) -> str:
    return text.replace("|", "/").replace("*", "").rstrip(".")


@cache
def _league() -> list[Row]:
    return rows()


@cache
def _vectors(name: str) -> list[dict[str, Any]]:
    held = tomllib.loads((VECTORS / name).read_text("utf-8"))
    return [entry for key in ("vector", "row") for entry in held.get(key, [])]


def _example(title: str, lines: Iterable[str]) -> str:
    return "\n".join([f"*{title}*\n", "```text", *lines, "```", ""])


def _client_bytes(row: str) -> Iterator[str]:
    """Return examples of a request and the bytes that come back, as a client sees them."""
    plain = [v for v in _vectors("modbus_client.toml") if v["id"].startswith(row)]
    for vector in plain[:EXAMPLES]:
        result = vector.get("error") or "the value is accepted"
        yield _example(
            f"client: {vector['id'].removeprefix(row).strip()}",
            [f"request   {vector.get('sent', '')}", f"received  {vector.get('received', '')}", f"result    {result}"],
        )
    for entry in [v for v in _vectors("canopen_master.toml") if v.get("case") == row and v.get("bus")][:EXAMPLES]:
        yield _example(f"client: {entry['title']} (ms, > sent, < received)", entry["bus"])


def _device_bytes(row: str) -> Iterator[str]:
    """Return examples of what a device receives and answers."""
    for vector in [v for v in _vectors("modbus_server.toml") if v["id"].startswith(row)][:EXAMPLES]:
        lines = []
        for step in vector["steps"]:
            lines += [f"{step['at_ms']:>6} ms  received  {step['hear']}"] if step["hear"] else []
            lines += [f"{step['at_ms']:>6} ms  answer    {answer}" for answer in step["say"]]
        yield _example(
            f"device ({WIRES.get(vector.get('wire', 'rtu'), 'TCP')}): {vector['id'].removeprefix(row).strip()}", lines
        )
    for entry in [v for v in _vectors("canopen_slave.toml") if v["id"].startswith(row)][:EXAMPLES]:
        heard = [(at, f"received  {frame}") for at, frame in entry["hear"] if not str(frame).startswith("!")]
        said = [(at, f"answer    {frame}") for at, frame in entry["say"]]
        lines = [f"{at:>6} ms  {text}" for at, text in sorted((*heard, *said), key=lambda pair: pair[0])]
        yield _example(f"node: {entry['id'].removeprefix(row).strip()}", lines)
