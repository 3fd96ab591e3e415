"""Write a data sheet (EDS) of a CANopen node from a log of its bus, sufficient to emulate the logged behaviour.

Its objects are those that were read or written over SDO, with the sizes seen; process data without a mapping in the log is
declared as in the frame, one object for each byte. A log contains no names and meanings, and neither does the data sheet. The
module does no I/O.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from statistics import median

from fieldtwin.capture.decoding.canopen_bus import CanopenBusDecoder
from fieldtwin.capture.decoding.exchange import DecodedExchange
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.errors import UsageError

Key = tuple[int, int]

MAX_OBJECTS = 10_000
_TYPES = {1: 0x05, 2: 0x06, 3: 0x16, 4: 0x07, 5: 0x18, 6: 0x19, 7: 0x1A, 8: 0x1B}
"""Type codes of UNSIGNED by number of bytes (CiA 301, 7.4.7.1)."""
_OCTETS = 0x0A
_FIRST_FREE = 0x5F00
"""First index of the manufacturer's objects that hold process data without a mapping."""
_PDO_PARAMETERS = range(0x1400, 0x1C00)
_PERIODS = 100_000


@dataclass(slots=True)
class _Object:
    sizes: set[int] = field(default_factory=set)
    written: bool = False


@dataclass(slots=True)
class _Pdo:
    length: int = 0
    last_ns: int = -1
    gaps_ms: list[float] = field(default_factory=list)

    def saw(self, t_ns: int, length: int) -> None:
        if self.last_ns >= 0 and len(self.gaps_ms) < _PERIODS:
            self.gaps_ms.append((t_ns - self.last_ns) / 1e6)
        self.last_ns = t_ns
        self.length = max(self.length, length)

    @property
    def period_ms(self) -> int:
        return min(max(round(median(self.gaps_ms)), 1), 65_535) if len(self.gaps_ms) >= 3 else 0


def nodes_of(frames: Iterable[tuple[int, CanFrame]]) -> list[int]:
    """Return the nodes that answered or sent messages by themselves in a log."""
    bases = (0x80, 0x180, 0x280, 0x380, 0x480, 0x580, 0x700)
    found = {
        f.can_id & 0x7F for _, f in frames if not (f.extended or f.remote or f.error) and f.can_id & ~0x7F in bases
    }
    return sorted(found - {0})


class LogSheet:
    """The information about `node` in a log; `eds` is the data sheet."""

    def __init__(self, frames: Iterable[tuple[int, CanFrame]], node: int) -> None:
        self.node = node
        self._objects: dict[Key, _Object] = {}
        self._mapped: dict[Key, int] = {}
        self._mappings: set[int] = set()
        self._pdos: dict[tuple[bool, int], _Pdo] = {}
        self._beat = _Pdo()
        wire = CanopenBusDecoder("can", ())
        for t_ns, frame in frames:
            for done in wire.feed(frame, t_ns)[1]:
                if done.unit == node:
                    self._note(done)
        if not self._objects and not self._pdos and self._beat.last_ns < 0:
            raise UsageError(f"the log holds nothing of node {node}")

    def _note(self, done: DecodedExchange) -> None:
        if done.service in ("SDO upload", "SDO download"):
            self._transfer(done)
        elif done.service[1:4] == "PDO" and done.service[4:].isdigit():
            pdo = self._pdos.setdefault((done.service[0] == "T", int(done.service[4:])), _Pdo())
            pdo.saw(done.t_ns, len(done.request))
        elif done.service == "heartbeat":
            self._beat.saw(done.t_ns, 1)

    def _transfer(self, done: DecodedExchange) -> None:
        key = done.spans[0].address, done.spans[0].subindex
        if key not in self._objects and len(self._objects) >= MAX_OBJECTS:
            return
        if done.abort is not None or not isinstance(done.value, str):
            return  # an object that was always refused has no known size
        raw = bytes.fromhex(done.value)
        found = self._objects.setdefault(key, _Object())
        found.sizes.add(len(raw))
        found.written |= done.service == "SDO download"
        if 0x1600 <= key[0] < 0x1800 or 0x1A00 <= key[0] < 0x1C00:
            self._mappings.add(key[0])
            if key[1] and len(raw) == 4 and any(raw):
                self._mapped[int.from_bytes(raw[2:4], "little"), raw[1]] = raw[0]

    # -- the text -----------------------------------------------------------------------------------------------------

    def eds(self, name: str) -> str:
        """Return the text of the data sheet; `name` is the name of the product."""
        indices: dict[int, dict[int, str]] = {}
        for (index, subindex), what in self._objects.items():
            size = next(iter(what.sizes)) if len(what.sizes) == 1 else 0
            access = "rw" if what.written else "ro"
            indices.setdefault(index, {})[subindex] = _entry(_TYPES.get(size, _OCTETS), access)
        for (index, subindex), bits in self._mapped.items():
            kind = _TYPES.get((bits + 7) // 8, _OCTETS)
            indices.setdefault(index, {}).setdefault(subindex, _entry(kind, "rw"))
        indices.setdefault(0x1000, {0: _entry(0x07, "ro", "0")})
        indices.setdefault(0x1001, {0: _entry(0x05, "ro", "0")})
        indices.setdefault(0x1018, {1: _entry(0x07, "ro", "0")})
        if self._beat.period_ms:
            indices[0x1017] = {0: _entry(0x06, "rw", str(self._beat.period_ms))}
        for (sends, number), pdo in sorted(self._pdos.items()):
            self._declare(indices, sends, number, pdo)
        return _text(name, indices, self._pdos)

    def _declare(self, indices: dict[int, dict[int, str]], sends: bool, number: int, pdo: _Pdo) -> None:
        """Declare communication and mapping of a PDO; without a mapping in the log each byte is a separate object."""
        base, offset = (0x180, 0x1800) if sends else (0x200, 0x1400)
        parameters = indices.setdefault(offset + number - 1, {})
        parameters.setdefault(1, _entry(0x07, "rw", f"$NODEID+0x{base + 0x100 * (number - 1):X}"))
        parameters.setdefault(2, _entry(0x05, "rw", "255"))
        if sends:
            parameters.setdefault(3, _entry(0x06, "rw", "0"))
            parameters.setdefault(5, _entry(0x06, "rw", str(pdo.period_ms)))
        at = offset + 0x200 + number - 1
        if at in self._mappings:
            return
        free = _FIRST_FREE + (0 if sends else 0x10) + number
        mapping = indices.setdefault(at, {})
        mapping[0] = _entry(0x05, "rw", str(pdo.length))
        data = indices.setdefault(free, {})
        for byte in range(1, pdo.length + 1):
            data[byte] = _entry(0x05, "ro" if sends else "rw", "0")
            mapping[byte] = _entry(0x07, "rw", f"0x{free << 16 | byte << 8 | 8:08X}")


def _entry(kind: int, access: str, default: str = "") -> str:
    mappable = 1 if kind in _TYPES.values() else 0
    value = f"DefaultValue={default}\n" if default else ""
    return f"ObjectType=0x7\nDataType=0x{kind:04X}\nAccessType={access}\n{value}PDOMapping={mappable}\n"


def _text(name: str, indices: dict[int, dict[int, str]], pdos: Iterable[tuple[bool, int]]) -> str:
    plain = "".join(c if c.isprintable() and c not in "=;[]" else "-" for c in name)
    kinds = [sends for sends, _ in pdos]
    head = [
        "[FileInfo]", f"FileName={plain}.eds", "FileVersion=1", "FileRevision=0", "EDSVersion=4.0",
        "Description=made from a log; names and meanings are not known", "CreationTime=12:00AM", "CreationDate=01-01-2026",
        "CreatedBy=fieldtwin", "ModificationTime=12:00AM", "ModificationDate=01-01-2026", "ModifiedBy=fieldtwin", "",
        "[DeviceInfo]", "VendorName=unknown", "VendorNumber=0", f"ProductName={plain}", "ProductNumber=0", "RevisionNumber=0",
        "OrderCode=", *(f"BaudRate_{k}=1" for k in (10, 20, 50, 125, 250, 500, 800, 1000)), "SimpleBootUpMaster=0",
        "SimpleBootUpSlave=1", "Granularity=8", "DynamicChannelsSupported=0", "CompactPDO=0", "GroupMessaging=0",
        f"NrOfRXPDO={kinds.count(False)}", f"NrOfTXPDO={kinds.count(True)}", "LSS_Supported=0", "",
    ]  # fmt: skip
    mandatory = [i for i in sorted(indices) if i in (0x1000, 0x1001, 0x1018)]
    optional = [i for i in sorted(indices) if i not in mandatory and not 0x2000 <= i < 0x6000]
    own = [i for i in sorted(indices) if 0x2000 <= i < 0x6000]
    for title, found in (("MandatoryObjects", mandatory), ("OptionalObjects", optional), ("ManufacturerObjects", own)):
        head += [
            f"[{title}]",
            f"SupportedObjects={len(found)}",
            *(f"{n}=0x{i:04X}" for n, i in enumerate(found, 1)),
            "",
        ]
    return "\n".join(head) + "\n" + "\n".join(_object(index, subs) for index, subs in sorted(indices.items()))


def _object(index: int, subs: dict[int, str]) -> str:
    if set(subs) == {0} and index not in _PDO_PARAMETERS and index != 0x1018:
        return f"[{index:X}]\nParameterName=Object {index:04X}h\n{subs[0]}"
    subs.setdefault(0, _entry(0x05, "ro", str(max(subs))))
    text = f"[{index:X}]\nParameterName=Object {index:04X}h\nObjectType=0x9\nSubNumber={len(subs)}\n"
    for subindex, entry in sorted(subs.items()):
        text += f"\n[{index:X}sub{subindex:X}]\nParameterName=Object {index:04X}h:{subindex:02X}\n{entry}"
    return text
