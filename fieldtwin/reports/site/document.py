"""The data of a site acceptance document: devices, actions, deviations, and the files that prove them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

Kind = Literal["check", "dump", "comparison", "difference"]
Weight = Literal["deviation", "robustness", "field problem", "open", "waived"]
"""A deviation contradicts the standard or the reference; the operator accepts it or has it corrected.

Robustness findings and known field problems break no clause. An open point could not be decided. A waived deviation has an
owner.
"""
SERIAL = "serial number"


@dataclass(frozen=True, slots=True)
class Deviation:
    """A finding. `where` is an address or a case, `source` the standard's clause or the reference."""

    weight: Weight
    what: str
    expected: str
    found: str
    where: str = ""
    source: str = ""


@dataclass(frozen=True, slots=True)
class Table:
    """A table that is printed as it is. Each row has one text for each of the `columns`."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    left_out: int = 0
    """Number of rows that were left out for lack of space."""


@dataclass(frozen=True, slots=True)
class DocumentPiece:
    """One file: the result of one action on one device.

    `facts` are in reading order. `protocol`, `address` and `endpoint` identify the device; `verdict` is one word, `summary` one
    line.
    """

    kind: Kind
    protocol: str
    address: int
    endpoint: str
    when: str
    by: str
    verdict: str
    summary: str
    identity: Mapping[str, str] = field(default_factory=dict)
    facts: tuple[tuple[str, str], ...] = ()
    deviations: tuple[Deviation, ...] = ()
    tables: tuple[Table, ...] = ()
    command: str = ""

    @property
    def good(self) -> bool:
        """Return whether the verdict is passed, whole, sampled or met, so that the action needs no attention."""
        return self.verdict in ("passed", "whole", "sampled", "met")


@dataclass(frozen=True, slots=True)
class SourceFile:
    """A file as it was read: its name, size and SHA-256, which prove later that it is the same file."""

    name: str
    size: int
    sha256: str
    kind: Kind
    when: str
    by: str
    command: str


@dataclass
class ReportedDevice:
    """One device: all pieces with the same protocol, bus and address. The user can set `label` and `serial`."""

    number: int
    protocol: str
    address: int
    endpoint: str
    pieces: list[DocumentPiece] = field(default_factory=list)
    label: str = ""
    serial_said: str = ""

    @property
    def name(self) -> str:
        """Return the name of the device, such as ``unit 1`` or ``node 5``."""
        return f"{'node' if self.protocol == 'canopen' else 'unit'} {self.address}"

    @property
    def identity(self) -> dict[str, str]:
        """Return the device's identification from all pieces; the latest value counts."""
        said: dict[str, str] = {}
        for piece in sorted(self.pieces, key=lambda piece: piece.when):
            said.update(piece.identity)
        return said

    @property
    def deviation_count(self) -> int:
        """Return the number of deviations of all pieces."""
        return sum(found.weight == "deviation" for piece in self.pieces for found in piece.deviations)

    @property
    def serial(self) -> str:
        """Return the serial number that the user gave, else the device's own, else an empty text.

        A CANopen node has 0 for none.
        """
        said = self.identity.get(SERIAL, "")
        return self.serial_said or ("" if said.split(" ")[0] == "0" else said)

    @property
    def type(self) -> str:
        """Return vendor and product if the device reports them; else the profile with which it was read."""
        said = self.identity
        words = [said.get(name, "") for name in ("vendor", "product", "name", "product code", "model", "server id")]
        return ", ".join(dict.fromkeys(word for word in words if word)) or said.get("profile", "")

    @property
    def revision(self) -> str:
        """Return the device's revisions of hardware and software; empty if it does not report them."""
        said = self.identity
        named = (("revision", ""), ("hardware", "hardware "), ("software", "software "))
        return ", ".join(prefix + said[name] for name, prefix in named if said.get(name))


@dataclass(frozen=True)
class SiteDocument:
    """The whole document. `prepared` is ISO 8601 in UTC."""

    site: str
    by: str
    prepared: str
    devices: Sequence[ReportedDevice]
    sources: Sequence[SourceFile]
    remarks: str = ""
    customer: str = ""

    @property
    def deviations(self) -> list[tuple[ReportedDevice, DocumentPiece, Deviation]]:
        """Return all deviations, those that need a decision first."""
        order = {weight: at for at, weight in enumerate(("deviation", "open", "robustness", "field problem", "waived"))}
        found = [(d, p, deviation) for d in self.devices for p in d.pieces for deviation in p.deviations]
        return sorted(found, key=lambda each: order[each[2].weight])

    def count(self, weight: Weight) -> int:
        return sum(deviation.weight == weight for _, _, deviation in self.deviations)

    def as_json(self) -> dict[str, Any]:
        """Return the document as JSON data."""
        return {
            "kind": "fieldtwin site report",
            "version": 1,
            "site": self.site,
            "by": self.by,
            "customer": self.customer,
            "prepared": self.prepared,
            "remarks": self.remarks,
            "devices": [
                {
                    "number": d.number, "label": d.label, "device": d.name, "protocol": d.protocol, "endpoint": d.endpoint,
                    "identity": d.identity, "serial_number": d.serial,
                    "done": [
                        {"kind": p.kind, "when": p.when, "by": p.by, "verdict": p.verdict, "summary": p.summary} for p in d.pieces
                    ],
                }
                for d in self.devices
            ],
            "deviations": [
                {
                    "number": n, "device": d.number, "kind": p.kind, "weight": v.weight, "where": v.where, "what": v.what,
                    "expected": v.expected, "found": v.found, "source": v.source,
                }
                for n, (d, p, v) in enumerate(self.deviations, 1)
            ],
            "files": [
                {"name": s.name, "size": s.size, "sha256": s.sha256, "kind": s.kind, "when": s.when, "by": s.by}
                for s in self.sources
            ],
        }  # fmt: skip
