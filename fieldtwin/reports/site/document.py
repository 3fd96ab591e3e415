"""What a site acceptance document is made of: devices, what was done to each, what deviated, the files that say so."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

Kind = Literal["check", "dump", "comparison", "difference"]
Weight = Literal["deviation", "robustness", "field problem", "open", "waived"]
"""A deviation contradicts the standard or the reference; the operator accepts it or has it corrected. No clause
requires what a robustness finding or a known field problem is about. An open point could not be decided. A waived deviation
has an owner."""
SERIAL = "serial number"


@dataclass(frozen=True, slots=True)
class Deviation:
    """Something that is not as it must be. `where` is an address or a case, `source` the standard's clause or the reference."""

    weight: Weight
    what: str
    expected: str
    found: str
    where: str = ""
    source: str = ""


@dataclass(frozen=True, slots=True)
class Table:
    """Something to be printed as it is. `rows` have as many texts as there are `columns`."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    left_out: int = 0
    """Rows that there is no room for."""


@dataclass(frozen=True, slots=True)
class Piece:
    """One file: something that was done to one device. `facts` are in the order in which people read them.

    `protocol`, `address` and `endpoint` say which device; `verdict` is one word, `summary` one line.
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


@dataclass(frozen=True, slots=True)
class Source:
    """A file as it was read: its name, size and SHA-256, so that nobody argues about another one later."""

    name: str
    size: int
    sha256: str
    kind: Kind
    when: str
    by: str
    command: str


@dataclass
class Device:
    """One device: all pieces with the same protocol, wire and address. `label` and `serial` may be said by the user."""

    number: int
    protocol: str
    address: int
    endpoint: str
    pieces: list[Piece] = field(default_factory=list)
    label: str = ""
    serial_said: str = ""

    @property
    def name(self) -> str:
        """``unit 1``, ``node 5``."""
        return f"{'node' if self.protocol == 'canopen' else 'unit'} {self.address}"

    @property
    def identity(self) -> dict[str, str]:
        """What it says of itself, in all pieces; the latest word counts."""
        said: dict[str, str] = {}
        for piece in sorted(self.pieces, key=lambda piece: piece.when):
            said.update(piece.identity)
        return said

    @property
    def serial(self) -> str:
        """What the user says, else what the device says; empty where nobody does. A CANopen node says 0 for none."""
        said = self.identity.get(SERIAL, "")
        return self.serial_said or ("" if said.split(" ")[0] == "0" else said)

    @property
    def type(self) -> str:
        """Maker and product, as far as it says; else the profile by which it was read."""
        said = self.identity
        words = [said.get(name, "") for name in ("vendor", "product", "name", "product code", "model", "server id")]
        return ", ".join(dict.fromkeys(word for word in words if word)) or said.get("profile", "")

    @property
    def revision(self) -> str:
        """Its revision, hardware and software, as far as it says."""
        said = self.identity
        named = (("revision", ""), ("hardware", "hardware "), ("software", "software "))
        return ", ".join(prefix + said[name] for name, prefix in named if said.get(name))


@dataclass(frozen=True)
class Document:
    """The whole. `prepared` is ISO 8601 in UTC."""

    site: str
    by: str
    prepared: str
    devices: Sequence[Device]
    sources: Sequence[Source]
    remarks: str = ""
    customer: str = ""

    @property
    def deviations(self) -> list[tuple[Device, Piece, Deviation]]:
        """All of them, those to be decided on first."""
        order = {weight: at for at, weight in enumerate(("deviation", "open", "robustness", "field problem", "waived"))}
        found = [(d, p, deviation) for d in self.devices for p in d.pieces for deviation in p.deviations]
        return sorted(found, key=lambda each: order[each[2].weight])

    def count(self, weight: Weight) -> int:
        return sum(deviation.weight == weight for _, _, deviation in self.deviations)

    def as_json(self) -> dict[str, Any]:
        """For programs."""
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
