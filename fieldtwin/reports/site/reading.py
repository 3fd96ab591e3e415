"""Read files for the site acceptance document: find each file's device and results.

Each kind of file has a function. The content is not trusted: all of it becomes text of the document.
"""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

from fieldtwin.conformance.core.case import Basis
from fieldtwin.gateway.core.errors import FileInvalid, UsageError
from fieldtwin.reports.site.document import (
    Deviation,
    DocumentPiece,
    Kind,
    ReportedDevice,
    SiteDocument,
    SourceFile,
    Table,
    Weight,
)
from fieldtwin.reports.site.reading_dump import dump_piece

MOST_BYTES = 1 << 28
"""Largest size of a JSON file in bytes; dumps have no limit, because they are read line by line."""
MOST_ROWS = 200
"""Largest number of rows of one table: longer lists belong in a file, not on paper."""
SUFFIXES = (".json", ".jsonl")


class UnknownFileKind(FileInvalid):
    """Raised for a file of a kind that does not belong in the document."""


def read_site(
    paths: Iterable[Path], *, site: str, by: str, prepared: str, customer: str = "", remarks: str = ""
) -> tuple[SiteDocument, list[str]]:
    """Return the document of all files, and the files of folders that were left out, with the reason.

    Raises `FileInvalid` for a named file of an unsuitable kind, and for any damaged file; `UsageError` without files.
    """
    pieces: list[tuple[Path, DocumentPiece]] = []
    left_out: list[str] = []
    for path in paths:
        if not path.is_dir():
            pieces.append((path, read_piece(path)))
            continue
        for file in sorted(p for p in path.rglob("*") if p.suffix in SUFFIXES and p.is_file()):
            try:
                pieces.append((file, read_piece(file)))
            except UnknownFileKind as e:
                left_out.append(str(e))
    if not pieces:
        raise UsageError(
            "nothing to report", expected="dumps, and the JSON of check, diff or compare", got="no file of these kinds"
        )
    devices: dict[tuple[str, str, int], ReportedDevice] = {}
    for _, piece in sorted(pieces, key=lambda each: (each[1].protocol, each[1].endpoint, each[1].address)):
        key = (piece.protocol, piece.endpoint, piece.address)
        devices.setdefault(key, ReportedDevice(len(devices) + 1, *_key(piece))).pieces.append(piece)
    for device in devices.values():
        device.pieces.sort(key=lambda piece: piece.when)
    sources = [_source(path, piece) for path, piece in pieces]
    return SiteDocument(site, by, prepared, list(devices.values()), sources, remarks, customer), left_out


def _key(piece: DocumentPiece) -> tuple[str, int, str]:
    return piece.protocol, piece.address, piece.endpoint


def _source(path: Path, piece: DocumentPiece) -> SourceFile:
    digest = hashlib.sha256()
    try:
        with path.open("rb") as file:
            while chunk := file.read(1 << 20):
                digest.update(chunk)
        size = path.stat().st_size
    except OSError as e:
        raise FileInvalid(f"cannot be read: {e.strerror or e}", path=str(path)) from e
    return SourceFile(path.name, size, digest.hexdigest(), piece.kind, piece.when, piece.by, piece.command)


def read_piece(path: Path) -> DocumentPiece:
    """Read one file. Raises `FileInvalid` if it does not belong in the document."""
    try:
        with path.open("rb") as file:
            head = file.readline(1 << 20)
            if b'"fieldtwin_dump"' in head:
                return dump_piece(path)
            if head.startswith(b'{"started"'):
                raise UnknownFileKind("a log of sent frames", path=str(path))
            raw = head + file.read(MOST_BYTES)
    except OSError as e:
        raise FileInvalid(f"cannot be read: {e.strerror or e}", path=str(path)) from e
    try:
        data = json.loads(raw)
    except (ValueError, RecursionError) as e:
        raise UnknownFileKind("not JSON", path=str(path), got=str(e)[:60]) from e
    kind = data.get("kind") if isinstance(data, dict) else None
    if kind not in READERS:
        known = ", ".join(f"the JSON of `{name}`" for name in READERS)
        raise UnknownFileKind(
            "not suitable for a document", path=str(path), expected=f"a dump, {known}", got=repr(kind)[:60]
        )
    try:
        return READERS[kind](data)
    except (KeyError, TypeError, ValueError, AttributeError, IndexError, OverflowError) as e:
        raise FileInvalid(f"not what `{kind}` writes", path=str(path), got=f"{type(e).__name__} {e}"[:80]) from e


# -- checks --------------------------------------------------------------------------------------------------------------


def check_piece(data: dict[str, Any]) -> DocumentPiece:
    """Read the JSON of `fieldtwin check modbus|canopen`."""
    about, cases, counts = data["about"], data["cases"], data["counts"]
    weights: dict[str, Weight] = {"failed": "deviation", "error": "deviation", "inconclusive": "open"}
    deviations = []
    noted: Counter[str] = Counter()
    for case in cases:
        weight: Weight | None = "waived" if case["waived"] else weights.get(case["verdict"])
        if weight == "deviation" and case["verdict"] == "failed":
            weight = _weight(case)
            noted[weight] += weight != "deviation"
        if weight is not None:
            deviations.append(_case(case, weight))
    words = ("passed", "failed", "robustness", "field problem", "inconclusive", "skipped")
    shown = Counter(counts)
    shown["failed"] -= noted.total()
    shown += noted
    skipped = [c for c in cases if c["verdict"] == "skipped" and not c["waived"]]
    here = [c for c in skipped if c["reason"] != "not on this kind of bus"]
    shown["skipped"] -= len(skipped) - len(here)
    bad = any(d.weight == "deviation" for d in deviations)
    facts = [
        ("played", f"test cases up to impact level {about['at_most']}"),
        ("wrote to", ", ".join(map(str, about["wrote"])) or "nothing"),
        ("reply timeout", f"{about['timeout_s']} s"),
        ("took", f"{about['took_s']} s"),
        ("with", f"fieldtwin {about['fieldtwin']} on {about['host']}"),
    ]
    passed = [c for c in cases if c["verdict"] == "passed"]
    tables = (
        _table(
            "Passed",
            ("case", "what", "source", "seen"),
            [(c["id"], c["title"], c["clause"], c["reason"]) for c in passed],
        ),
        _table("Not checked", ("case", "what", "why"), [(c["id"], c["title"], c["reason"]) for c in here]),
    )
    return DocumentPiece(
        "check", str(about["protocol"]), int(about["address"]), str(about["endpoint"]), str(about["started"]),
        str(about["by"]), "failed" if bad else "passed" if counts.get("passed") else "inconclusive",
        ", ".join(f"{shown[w]} {w}" for w in words if shown[w]),
        {str(k): str(v) for k, v in about["identity"].items()}, tuple(facts), tuple(deviations), tables, str(about["command"]),
    )  # fmt: skip


def _weight(case: dict[str, Any]) -> Weight:
    """Return the weight of a failed case: from its file, or from its test case if the file is older (version 1)."""
    said = case.get("basis") or bases().get(str(case["id"]), Basis.STANDARD.value)
    weights: dict[str, Weight] = {Basis.ROBUSTNESS.value: "robustness", Basis.FIELD.value: "field problem"}
    return weights.get(said, "deviation")


@cache
def bases() -> dict[str, str]:
    """Return, by case ID, the basis (`Basis.value`) of every test case for devices."""
    from fieldtwin.conformance.devices.canopen import cases as canopen_cases
    from fieldtwin.conformance.devices.modbus import cases as modbus_cases

    found = {case.id: case.basis.value for case in modbus_cases.CASES}
    return found | {case.id: case.basis.value for case in canopen_cases.CASES}


def _case(case: dict[str, Any], weight: Weight) -> Deviation:
    what, expected, found, where, source = (str(case[key]) for key in ("title", "expected", "reason", "id", "clause"))
    return Deviation(weight, what, expected, found, where, source)


# -- comparisons and differences -------------------------------------------------------------------------------------------


def compare_piece(data: dict[str, Any]) -> DocumentPiece:
    """Read the JSON of `fieldtwin compare`: a device against a recording."""
    about, found = data["about"], data["differences"]
    alike_ones: dict[tuple[str, ...], list[dict[str, Any]]] = {}
    for each in found:
        alike_ones.setdefault((each["what"], each["where"], each["request"]), []).append(each)
    deviations = [_difference(same) for same in list(alike_ones.values())[:MOST_ROWS]]
    if len(alike_ones) > MOST_ROWS:
        more = f"{len(alike_ones) - MOST_ROWS} more kinds, in the file"
        deviations.append(Deviation("deviation", "further differences", "none", more))
    slow = [row for row in data["latency"] if not row["alike"]]
    deviations += [
        Deviation("deviation", "latency differs", _ms(row["recorded_s"]), _ms(row["other_s"]), str(row["service"]))
        for row in slow
    ]
    unjudged = int(data.get("not_compared", 0))
    if unjudged:
        where = "the recording has no values at the position where the dialogue continued"
        deviations.append(
            Deviation("open", "not everything was compared", "all exchanges", f"{unjudged} not compared", source=where)
        )
    alike, timing = f"{100 * data['values']:.2f} %", data["timing"]
    facts = [
        ("against", str(about["against"])),
        ("compared", f"{data['compared']} exchanges, {data['left_out']} left out, {unjudged} not compared"),
        ("values", f"{alike} alike, {100 * data['least']:g} % required"),
        ("timing", "not judged" if timing is None else f"{100 * timing:.1f} %"),
    ]
    latency = [(r["service"], r["count"], _ms(r["recorded_s"]), _ms(r["other_s"])) for r in data["latency"]]
    tables = (_table("Latency: median, 90 %, 99 %", ("function", "exchanges", "recorded", "this one"), latency),)
    summary = f"{data['compared']} exchanges, {alike} alike"
    if data["met"]:  # a difference within the allowed share is not a deviation
        deviations = [replace(d, weight="waived", found=f"{d.found}; within the required share") for d in deviations]
    verdict = "met" if data["met"] else "inconclusive" if data.get("inconclusive") else "not met"
    return _headed("comparison", about, verdict, summary, facts, deviations, tables)


def _difference(same: list[dict[str, Any]]) -> Deviation:
    """Return all differences in one place as one finding, with the first as an example."""
    first = same[0]
    what, request, recorded, other, where = (str(first[k]) for k in ("what", "request", "recorded", "other", "where"))
    often = f", {len(same)} times, first" if len(same) > 1 else ","
    source = f"{request}{often} at {first['t_s']:.1f} s"
    return Deviation("deviation", f"{what} differs", recorded, other, where, source)


def _ms(quantiles: list[float]) -> str:
    return ", ".join(f"{1000 * s:.1f}" for s in quantiles) + " ms"


def diff_piece(data: dict[str, Any]) -> DocumentPiece:
    """Read the JSON of `fieldtwin diff`: a dump against another one, or against a profile or an EDS."""
    about, found = data["about"], data["found"]
    deviations = [
        Deviation("deviation", f"{d['name']}: {d['kind']}", str(d["right"]), str(d["left"]), str(d["at"]))
        for d in found[:MOST_ROWS]
    ]
    if len(found) > MOST_ROWS:
        deviations.append(
            Deviation("deviation", "further differences", "none", f"{len(found) - MOST_ROWS} more, in the file")
        )
    facts = [("against", str(about["against"])), ("compared", f"{data['compared']} values")]
    tables = (_table("Notes", ("note",), [(note,) for note in data["notes"]]),)
    summary = f"{data['compared']} compared, {len(found)} different"
    return _headed("difference", about, "different" if found else "same", summary, facts, deviations, tables)


def _headed(
    kind: Kind,
    about: dict[str, Any],
    verdict: str,
    summary: str,
    facts: list[tuple[str, str]],
    deviations: list[Deviation],
    tables: tuple[Table, ...],
) -> DocumentPiece:
    """Return a piece for JSON with the header of `about.headed`."""
    where = str(about["endpoint"]) or str(about["device"])
    return DocumentPiece(
        kind, str(about["protocol"]), int(about["address"]), where, str(about["started"]), str(about["by"]), verdict, summary,
        {}, tuple(facts), tuple(deviations), tables, str(about["command"]),
    )  # fmt: skip


def _table(title: str, columns: tuple[str, ...], rows: list[tuple[Any, ...]]) -> Table:
    shown = tuple(tuple(str(text) for text in row) for row in rows[:MOST_ROWS])
    return Table(title, columns, shown, max(0, len(rows) - MOST_ROWS))


READERS: dict[str, Callable[[dict[str, Any]], DocumentPiece]] = {
    "fieldtwin check": check_piece,
    "fieldtwin compare": compare_piece,
    "fieldtwin diff": diff_piece,
}
