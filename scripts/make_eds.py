#!/usr/bin/env python3
"""Generate the electronic data sheets of fieldtwin's reference nodes (CiA 306-1), each from a table of its objects.

    scripts/make_eds.py [--out DIR]

The objects are the public facts of the device profiles: indices, types, access and meaning, as printed in manufacturers'
manuals. No such products exist: the vendor ID is 0, which CiA does not assign. A test compares the files with the output of
this script.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent

BOOL, I8, I16, I32, U8, U16, U32, F32, TEXT = 0x01, 0x02, 0x03, 0x04, 0x05, 0x06, 0x07, 0x08, 0x09
VAR, ARRAY, RECORD = 7, 8, 9
BITS = {BOOL: 1, I8: 8, U8: 8, I16: 16, U16: 16, I32: 32, U32: 32, F32: 32}
ROOM = 8
"""Entries of a mapping: up to the number of bytes in a frame."""


@dataclass(frozen=True)
class Sub:
    """One entry. `mapped` is whether a PDO may carry it; `limits` are inclusive."""

    name: str
    kind: int
    access: str = "ro"
    default: object = 0
    mapped: bool = False
    limits: tuple[object, object] | None = None

    def lines(self) -> Iterable[str]:
        yield f"ParameterName={self.name}"
        yield "ObjectType=0x7"
        yield f"DataType=0x{self.kind:04X}"
        if self.limits is not None:
            yield f"LowLimit={self.limits[0]}"
            yield f"HighLimit={self.limits[1]}"
        yield f"AccessType={self.access}"
        yield f"DefaultValue={self.default}"
        yield f"PDOMapping={int(self.mapped)}"


@dataclass(frozen=True)
class Object:
    """One index. A VAR has the entry 0 only; entry 0 of an ARRAY or RECORD holds the number of its entries."""

    index: int
    name: str
    kind: int
    subs: dict[int, Sub]

    def lines(self) -> Iterable[str]:
        if self.kind == VAR:
            yield f"[{self.index:04X}]"
            yield from self.subs[0].lines()
            return
        yield f"[{self.index:04X}]"
        yield f"ParameterName={self.name}"
        yield f"ObjectType=0x{self.kind:X}"
        yield f"SubNumber={len(self.subs)}"
        for number, sub in sorted(self.subs.items()):
            yield ""
            yield f"[{self.index:04X}sub{number:X}]"
            yield from sub.lines()


def var(index: int, name: str, kind: int, access: str = "ro", default: object = 0, **more: object) -> Object:
    return Object(index, name, VAR, {0: Sub(name, kind, access, default, **more)})  # type: ignore[arg-type]


def array(index: int, name: str, kind: int, access: str, defaults: Sequence[object], **more: object) -> Object:
    """Entries of one type, numbered from 1."""
    subs = {0: Sub("Highest sub-index supported", U8, "const", len(defaults))}
    for number, default in enumerate(defaults, 1):
        subs[number] = Sub(f"{name} {number}", kind, access, default, **more)  # type: ignore[arg-type]
    return Object(index, name, ARRAY, subs)


def record(index: int, name: str, subs: dict[int, Sub]) -> Object:
    return Object(index, name, RECORD, {0: Sub("Highest sub-index supported", U8, "const", max(subs)), **subs})


def pdo(index: int, base: int, kind: int, event_ms: int | None, maps: Sequence[tuple[int, int, int]]) -> list[Object]:
    """A PDO's communication and mapping parameters; `maps` are (index, subindex, type). An RPDO has no times."""
    what = "TPDO" if index >= 0x1800 else "RPDO"
    subs = {
        1: Sub(f"COB-ID used by {what}", U32, "rw", f"$NODEID+0x{base:X}"),
        2: Sub("Transmission type", U8, "rw", kind),
    }
    if event_ms is not None:
        subs |= {3: Sub("Inhibit time", U16, "rw", 0), 5: Sub("Event timer", U16, "rw", event_ms)}
    entries = {0: Sub("Number of mapped objects", U8, "rw", len(maps), limits=(0, ROOM))}
    for number in range(1, ROOM + 1):
        at = maps[number - 1] if number <= len(maps) else None
        code = at[0] << 16 | at[1] << 8 | BITS[at[2]] if at else 0
        entries[number] = Sub(f"Mapped object {number}", U32, "rw", f"0x{code:08X}")
    return [
        record(index, f"{what} communication parameter", subs),
        Object(index + 0x200, f"{what} mapping parameter", RECORD, entries),
    ]


@dataclass(frozen=True)
class Sheet:
    """A device: `profile` is the low word of 1000h, `detail` the high one; `notes` head the file."""

    name: str
    profile: int
    detail: int
    product: str
    notes: tuple[str, ...]
    objects: list[Object] = field(default_factory=list)

    @property
    def file(self) -> str:
        return f"{self.name}.eds"


def communication(sheet: Sheet) -> list[Object]:
    """The objects of CiA 301 v4.2 in every node here."""
    return [
        var(0x1000, "Device type", U32, default=f"0x{sheet.detail << 16 | sheet.profile:08X}"),
        var(0x1001, "Error register", U8, mapped=True),
        array(0x1003, "Pre-defined error field", U32, "ro", [0] * 4),
        var(0x1005, "COB-ID SYNC message", U32, "rw", "0x80"),
        var(0x1008, "Manufacturer device name", TEXT, "const", sheet.product),
        var(0x1009, "Manufacturer hardware version", TEXT, "const", "none"),
        var(0x100A, "Manufacturer software version", TEXT, "const", "1.0.0"),
        array(0x1010, "Store parameters", U32, "rw", [1]),
        array(0x1011, "Restore default parameters", U32, "rw", [1]),
        var(0x1014, "COB-ID EMCY", U32, "rw", "$NODEID+0x80"),
        var(0x1015, "Inhibit time EMCY", U16, "rw"),
        array(0x1016, "Consumer heartbeat time", U32, "rw", [0]),
        var(0x1017, "Producer heartbeat time", U16, "rw"),
        record(
            0x1018,
            "Identity object",
            {
                1: Sub("Vendor-ID", U32),
                2: Sub("Product code", U32, default=f"0x{int(str(sheet.profile), 16):X}"),
                3: Sub("Revision number", U32, default="0x10000"),
                4: Sub("Serial number", U32),
            },
        ),
        array(0x1029, "Error behavior", U8, "rw", [0], limits=(0, 2)),
        record(
            0x1200,
            "SDO server parameter",
            {
                1: Sub("COB-ID client to server", U32, "ro", "$NODEID+0x600"),
                2: Sub("COB-ID server to client", U32, "ro", "$NODEID+0x580"),
            },
        ),
    ]


def text(sheet: Sheet) -> str:
    """Return the whole file."""
    objects = {o.index: o for o in [*communication(sheet), *sheet.objects]}
    objects[0x1003].subs[0] = Sub("Number of errors", U8, "rw", 0)  # written with 0 to clear them
    mandatory = [0x1000, 0x1001, 0x1018]
    optional = sorted(i for i in objects if i not in mandatory)
    tpdos = sum(0x1800 <= i < 0x1A00 for i in objects)
    rpdos = sum(0x1400 <= i < 0x1600 for i in objects)
    lines = [f"; {note}".rstrip() for note in sheet.notes]
    lines += ["; Written by scripts/make_eds.py: change its table, not this file.", ""]
    lines += _section("FileInfo", _file_info(sheet)) + _section("DeviceInfo", _device_info(sheet, rpdos, tpdos))
    lines += _section("DummyUsage", {f"Dummy{kind:04X}": 0 for kind in range(1, 8)})
    lines += _section(
        "Comments", {"Lines": 1, "Line1": "A reference device of the fieldtwin project; no such product exists."}
    )
    for title, indices in (("MandatoryObjects", mandatory), ("OptionalObjects", optional)):
        lines += _section(
            title, {"SupportedObjects": len(indices)} | {str(n): f"0x{i:04X}" for n, i in enumerate(indices, 1)}
        )
        for index in indices:
            lines += [*objects[index].lines(), ""]
    lines += _section("ManufacturerObjects", {"SupportedObjects": 0})
    return "\n".join(lines).rstrip() + "\n"


def _section(name: str, values: Mapping[str, object]) -> list[str]:
    return [f"[{name}]", *(f"{key}={value}" for key, value in values.items()), ""]


def _file_info(sheet: Sheet) -> dict[str, object]:
    return {
        "FileName": sheet.file, "FileVersion": 1, "FileRevision": 0, "EDSVersion": "4.0", "Description": sheet.product,
        "CreationTime": "12:00PM", "CreationDate": "01-05-2026", "CreatedBy": "fieldtwin",
        "ModificationTime": "12:00PM", "ModificationDate": "01-05-2026", "ModifiedBy": "fieldtwin",
    }  # fmt: skip


def _device_info(sheet: Sheet, rpdos: int, tpdos: int) -> dict[str, object]:
    return {
        "VendorName": "fieldtwin (reference device, no product)", "VendorNumber": 0, "ProductName": sheet.product,
        "ProductNumber": f"0x{int(str(sheet.profile), 16):08X}", "RevisionNumber": "0x00010000", "OrderCode": "none",
        **{f"BaudRate_{rate}": 1 for rate in (10, 20, 50, 125, 250, 500, 800, 1000)},
        "SimpleBootUpMaster": 0, "SimpleBootUpSlave": 1, "Granularity": 8, "DynamicChannelsSupported": 0,
        "CompactPDO": 0, "GroupMessaging": 0, "NrOfRXPDO": rpdos, "NrOfTXPDO": tpdos, "LSS_Supported": 0,
    }  # fmt: skip


def _notes(what: str, profile: str, *more: str) -> tuple[str, ...]:
    return (
        f"Electronic data sheet of fieldtwin's reference {what} (CiA 306-1).",
        "",
        "A reference device of this project: no such product exists. The vendor id is 0, which CiA assigns to nobody.",
        f"Objects follow CiA 301 v4.2 and {profile}.",
        *more,
    )


def io_module() -> Sheet:
    """CiA 401-1: digital inputs and outputs in groups of eight, analogue ones of 16 bits."""
    low, high = -(1 << 31), (1 << 31) - 1
    return Sheet(
        "io-cia401", 401, 0x000F, "fieldtwin reference I/O module",
        _notes("I/O module", "CiA 401 (generic I/O modules)", "16 digital inputs and outputs, 4 analogue inputs and 2 outputs;",
               "1000h says all four kinds in bits 16 to 19."),
        [
            *pdo(0x1400, 0x200, 255, None, [(0x6200, 1, U8), (0x6200, 2, U8)]),
            *pdo(0x1401, 0x300, 255, None, [(0x6411, 1, I16), (0x6411, 2, I16)]),
            *pdo(0x1800, 0x180, 255, 0, [(0x6000, 1, U8), (0x6000, 2, U8)]),
            *pdo(0x1801, 0x280, 255, 0, [(0x6401, n, I16) for n in (1, 2, 3, 4)]),
            array(0x6000, "Read input 8-bit", U8, "ro", [0, 0], mapped=True),
            array(0x6002, "Polarity input 8-bit", U8, "rw", [0, 0]),
            var(0x6005, "Global interrupt enable digital", BOOL, "rw", 1),
            array(0x6006, "Interrupt mask any change 8-bit", U8, "rw", ["0xFF"] * 2),
            array(0x6007, "Interrupt mask low-to-high 8-bit", U8, "rw", [0, 0]),
            array(0x6008, "Interrupt mask high-to-low 8-bit", U8, "rw", [0, 0]),
            array(0x6200, "Write output 8-bit", U8, "rw", [0, 0], mapped=True),
            array(0x6202, "Change polarity output 8-bit", U8, "rw", [0, 0]),
            array(0x6206, "Error mode output 8-bit", U8, "rw", ["0xFF"] * 2),
            array(0x6207, "Error value output 8-bit", U8, "rw", [0, 0]),
            array(0x6401, "Read analogue input 16-bit", I16, "ro", [0] * 4, mapped=True),
            array(0x6411, "Write analogue output 16-bit", I16, "rw", [0] * 2, mapped=True),
            array(0x6421, "Analogue input interrupt trigger selection", U8, "rw", [7] * 4, limits=(0, 31)),
            var(0x6423, "Analogue input global interrupt enable", BOOL, "rw", 0),
            array(0x6424, "Analogue input interrupt upper limit integer", I32, "rw", [0] * 4, limits=(low, high)),
            array(0x6425, "Analogue input interrupt lower limit integer", I32, "rw", [0] * 4, limits=(low, high)),
            array(0x6426, "Analogue input interrupt delta unsigned", U32, "rw", [0] * 4),
            array(0x6443, "Analogue output error mode", U8, "rw", [1] * 2, limits=(0, 1)),
            array(0x6444, "Analogue output error value integer", I32, "rw", [0] * 2),
        ],
    )  # fmt: skip


def drive() -> Sheet:
    """CiA 402-2 and -3: one axis with profile, homing and cyclic synchronous modes; PDOs as the profile's defaults."""
    c, s, m = (0x6040, 0, U16), (0x6041, 0, U16), (0x6060, 0, I8)
    return Sheet(
        "drive-cia402", 402, 0x0002, "fieldtwin reference servo drive",
        _notes("servo drive", "CiA 402 (drives and motion control, IEC 61800-7-201 and -301)",
               "One axis. Modes: profile position (1), profile velocity (3), homing (6), cyclic synchronous position (8),",
               "velocity (9) and torque (10). Positions count in increments, 10,000 a turn; torques in 0.1 % of the rated one."),
        [
            *pdo(0x1400, 0x200, 255, None, [c]),
            *pdo(0x1401, 0x300, 255, None, [c, m]),
            *pdo(0x1402, 0x400, 255, None, [c, (0x607A, 0, I32)]),
            *pdo(0x1403, 0x500, 255, None, [c, (0x60FF, 0, I32)]),
            *pdo(0x1800, 0x180, 255, 0, [s]),
            *pdo(0x1801, 0x280, 255, 0, [s, (0x6061, 0, I8)]),
            *pdo(0x1802, 0x380, 255, 0, [s, (0x6064, 0, I32)]),
            *pdo(0x1803, 0x480, 255, 0, [s, (0x606C, 0, I32)]),
            var(0x6007, "Abort connection option code", I16, "rw", 1, limits=(0, 3)),
            var(0x603F, "Error code", U16, mapped=True),
            var(0x6040, "Controlword", U16, "rww", 0, mapped=True),
            var(0x6041, "Statusword", U16, mapped=True),
            var(0x605A, "Quick stop option code", I16, "rw", 2, limits=(0, 8)),
            var(0x605B, "Shutdown option code", I16, "rw", 0, limits=(0, 1)),
            var(0x605C, "Disable operation option code", I16, "rw", 1, limits=(0, 1)),
            var(0x605D, "Halt option code", I16, "rw", 1, limits=(1, 4)),
            var(0x605E, "Fault reaction option code", I16, "rw", 2, limits=(0, 4)),
            var(0x6060, "Modes of operation", I8, "rww", 0, mapped=True),
            var(0x6061, "Modes of operation display", I8, mapped=True),
            var(0x6062, "Position demand value", I32, mapped=True),
            var(0x6064, "Position actual value", I32, mapped=True),
            var(0x606B, "Velocity demand value", I32, mapped=True),
            var(0x606C, "Velocity actual value", I32, mapped=True),
            var(0x6065, "Following error window", U32, "rw", "0xFFFFFFFF"),
            var(0x606D, "Velocity window", U16, "rw", 50),
            var(0x606F, "Velocity threshold", U16, "rw", 10),
            var(0x6071, "Target torque", I16, "rww", 0, mapped=True),
            var(0x6072, "Max torque", U16, "rw", 1000),
            var(0x6074, "Torque demand", I16, mapped=True),
            var(0x6077, "Torque actual value", I16, mapped=True),
            var(0x6079, "DC link circuit voltage", U32, mapped=True),
            var(0x607A, "Target position", I32, "rww", 0, mapped=True),
            var(0x607C, "Home offset", I32, "rw", 0),
            array(0x607D, "Software position limit", I32, "rw", [0, 0]),
            var(0x607F, "Max profile velocity", U32, "rw", 500_000),
            var(0x6081, "Profile velocity", U32, "rww", 50_000, mapped=True),
            var(0x6083, "Profile acceleration", U32, "rw", 100_000),
            var(0x6084, "Profile deceleration", U32, "rw", 100_000),
            var(0x6085, "Quick stop deceleration", U32, "rw", 400_000),
            var(0x6098, "Homing method", I8, "rw", 37),
            array(0x6099, "Homing speeds", U32, "rw", [20_000, 2_000]),
            var(0x609A, "Homing acceleration", U32, "rw", 100_000),
            var(0x60B0, "Position offset", I32, "rww", 0, mapped=True),
            var(0x60B1, "Velocity offset", I32, "rww", 0, mapped=True),
            var(0x60B2, "Torque offset", I16, "rww", 0, mapped=True),
            record(0x60C2, "Interpolation time period", {
                1: Sub("Interpolation time period value", U8, "rw", 10), 2: Sub("Interpolation time index", I8, "rw", -3),
            }),
            var(0x60C5, "Max acceleration", U32, "rw", 5_000_000),
            var(0x60C6, "Max deceleration", U32, "rw", 5_000_000),
            array(0x60E3, "Supported homing methods", I16, "ro", [*range(1, 15), *range(17, 31), 33, 34, 35, 37]),
            var(0x60F4, "Following error actual value", I32, mapped=True),
            var(0x60FD, "Digital inputs", U32, mapped=True),
            var(0x60FF, "Target velocity", I32, "rww", 0, mapped=True),
            var(0x6502, "Supported drive modes", U32, default="0x000003A5"),
        ],
    )  # fmt: skip


def measuring_device() -> Sheet:
    """CiA 404: analogue inputs with a field value, a process value and the line between the two."""
    return Sheet(
        "measuring-cia404", 404, 0x0002, "fieldtwin reference measuring device",
        _notes("measuring device", "CiA 404 (measuring devices and closed-loop controllers), analogue input block",
               "Channel 1 is a pressure from 0 to 400 bar (4 to 20 mA), channel 2 a temperature from -40 to 125 degree Celsius",
               "(a platinum resistor of 84.27 to 147.95 ohm, taken as a line).",
               "Units by CiA 303-2: 004E0000h bar, 002D0000h degree Celsius."),
        [
            *pdo(0x1800, 0x180, 254, 100, [(0x9130, 1, I32), (0x9130, 2, I32)]),
            *pdo(0x1801, 0x280, 1, 0, [(0x6130, 1, F32), (0x6130, 2, F32)]),
            array(0x6100, "AI input FV", F32, "ro", ["0.0", "0.0"], mapped=True),
            array(0x6110, "AI sensor type", U16, "rw", [90, 30]),
            array(0x6112, "AI operating mode", U8, "rw", [1, 1], limits=(0, 1)),
            array(0x6120, "AI input scaling 1 FV", F32, "rw", ["4.0", "84.27"]),
            array(0x6121, "AI input scaling 1 PV", F32, "rw", ["0.0", "-40.0"]),
            array(0x6122, "AI input scaling 2 FV", F32, "rw", ["20.0", "147.95"]),
            array(0x6123, "AI input scaling 2 PV", F32, "rw", ["400.0", "125.0"]),
            array(0x6124, "AI input offset", F32, "rw", ["0.0", "0.0"]),
            array(0x6125, "AI autozero", U32, "wo", [0, 0]),
            array(0x6130, "AI input PV", F32, "ro", ["0.0", "0.0"], mapped=True),
            array(0x6131, "AI physical unit PV", U32, "ro", ["0x004E0000", "0x002D0000"]),
            array(0x6132, "AI decimal digits PV", U8, "rw", [2, 2], limits=(0, 5)),
            array(0x6148, "AI span start", F32, "rw", ["0.0", "-40.0"]),
            array(0x6149, "AI span end", F32, "rw", ["400.0", "125.0"]),
            array(0x6150, "AI status", U8, "ro", [0, 0], mapped=True),
            array(0x7130, "AI input PV integer 16-bit", I16, "ro", [0, 0], mapped=True),
            array(0x9130, "AI input PV integer 32-bit", I32, "ro", [0, 0], mapped=True),
        ],
    )  # fmt: skip


def encoder() -> Sheet:
    """CiA 406: a multi-turn absolute rotary encoder of 13 bits a turn and 12 bits of turns."""
    steps, turns = 8192, 4096
    return Sheet(
        "encoder-cia406", 406, 0x0002, "fieldtwin reference encoder",
        _notes("rotary encoder", "CiA 406 (encoders), multi-turn absolute",
               "8,192 steps a turn, 4,096 turns. Speed counts in turns a minute."),
        [
            *pdo(0x1800, 0x180, 254, 100, [(0x6004, 0, U32)]),
            *pdo(0x1801, 0x280, 1, 0, [(0x6004, 0, U32), (0x6030, 1, I16)]),
            var(0x6000, "Operating parameters", U16, "rw", 0),
            var(0x6001, "Measuring units per revolution", U32, "rw", steps),
            var(0x6002, "Total measuring range in measuring units", U32, "rw", steps * turns),
            var(0x6003, "Preset value", U32, "rw", 0),
            var(0x6004, "Position value", U32, mapped=True),
            array(0x6030, "Speed value", I16, "ro", [0], mapped=True),
            var(0x6500, "Operating status", U16),
            var(0x6501, "Single-turn resolution", U32, default=steps),
            var(0x6502, "Number of distinguishable revolutions", U16, default=turns),
            var(0x6503, "Alarms", U16, mapped=True),
            var(0x6504, "Supported alarms", U16),
            var(0x6505, "Warnings", U16, mapped=True),
            var(0x6506, "Supported warnings", U16),
            var(0x6507, "Profile and software version", U32, default="0x01000302"),
            var(0x6508, "Operating time", U32, default="0xFFFFFFFF"),
            var(0x6509, "Offset value", I32),
            record(0x650A, "Module identification", {
                1: Sub("Manufacturer offset value", I32), 2: Sub("Manufacturer minimum position value", I32),
                3: Sub("Manufacturer maximum position value", I32, default=steps * turns - 1),
            }),
            var(0x650B, "Serial number", U32),
        ],
    )  # fmt: skip


SHEETS = (io_module(), drive(), measuring_device(), encoder())


def main(argv: Sequence[str] | None = None) -> int:
    """Write every file; return the exit code."""
    parser = argparse.ArgumentParser(description="write the data sheets of fieldtwin's reference nodes")
    parser.add_argument("--out", type=Path, default=ROOT / "profiles" / "devices")
    out: Path = parser.parse_args(argv).out
    out.mkdir(parents=True, exist_ok=True)
    for sheet in SHEETS:
        (out / sheet.file).write_text(text(sheet), encoding="ascii", newline="\n")
        print(sheet.file, file=sys.stderr)
    return 0


if __name__ == "__main__":
    sys.exit(main())
