"""A device profile after its file was read: with the addresses as sent, sizes, poll groups and commands.

The driver and the emulator read the same profile and share nothing else: the driver decodes with
fieldtwin.gateway.devices.codec, the emulator encodes with its own codec, so that a mistake in one codec is not hidden by the
same mistake in the other. Messages show addresses in two forms, as printed in manuals and as sent.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from fieldtwin.gateway.core.files.profile_schema import ProfileForm

Table = Literal["coil", "discrete", "input", "holding"]

PRINTED: tuple[tuple[Table, int], ...] = (("coil", 0), ("discrete", 1), ("input", 3), ("holding", 4))
BIT_TABLES = ("coil", "discrete")
READ_FUNCTION: dict[Table, int] = {"coil": 1, "discrete": 2, "holding": 3, "input": 4}
REGISTERS_OF = {
    "int16": 1, "uint16": 1, "int32": 2, "uint32": 2, "float32": 2, "int64": 4, "uint64": 4, "float64": 4, "bool": 1,
    "bcd16": 1, "bcd32": 2,
}  # fmt: skip
INTEGER_RANGES = {
    "bool": (0, 1), "int8": (-0x80, 0x7F), "uint8": (0, 0xFF), "int16": (-0x8000, 0x7FFF), "uint16": (0, 0xFFFF),
    "int32": (-0x80000000, 0x7FFFFFFF), "uint32": (0, 0xFFFFFFFF), "int64": (-(1 << 63), (1 << 63) - 1),
    "uint64": (0, (1 << 64) - 1), "bcd16": (0, 9999), "bcd32": (0, 99_999_999),
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class RegisterRange:
    """`count` registers (or bits) of `table` from PDU address `address` (0 to 65535)."""

    table: Table
    address: int
    count: int

    @property
    def end(self) -> int:
        """Return the address after the last one."""
        return self.address + self.count

    def overlaps(self, other: RegisterRange) -> bool:
        """Return whether the two ranges have a register (or bit) in common."""
        return self.table == other.table and self.address < other.end and other.address < self.end

    def __str__(self) -> str:
        """Return both forms of the address, ``30001 (input:0)``, with the count if it is not 1."""
        digit = dict(PRINTED)[self.table]
        number = self.address + 1
        printed = f"{digit}{number:04d}" if number <= 9999 else f"{digit}{number:05d}"
        return f"{printed} ({self.table}:{self.address})" + (f" x {self.count}" if self.count != 1 else "")


@dataclass(frozen=True, slots=True)
class Tag:
    """One value of a device. Exactly one of `at` (Modbus) and `object` (CANopen index, subindex) is set."""

    name: str
    type: str
    at: RegisterRange | None
    object: tuple[int, int] | None
    order: str
    poll: str
    access: str
    unit: str
    scale: float
    offset: float
    values: tuple[tuple[int, str], ...]
    range: tuple[float, float] | None
    counter: bool
    secret: bool
    danger: str
    scale_by: str | None = None
    bits: tuple[int, int] | None = None
    sentinels: tuple[int, ...] = ()
    nonvolatile: bool = False

    @property
    def registers(self) -> RegisterRange:
        """Return the registers of a Modbus tag. Must not be called for a tag of a CANopen profile."""
        assert self.at is not None
        return self.at

    def number_of(self, value: int | float | str) -> int | float | str:
        """Return the number of a value name of the profile (`values: {0: OFF}`), and every other value unchanged."""
        return next((number for number, name in self.values if name == value), value)

    @property
    def readable(self) -> bool:
        return self.access != "wo"

    @property
    def writable(self) -> bool:
        return self.access != "ro"

    @property
    def is_text(self) -> bool:
        return self.type in ("string", "bytes")

    @property
    def is_bit(self) -> bool:
        """Return whether the value is a single bit: type bool, or one bit of a register."""
        return self.type == "bool" or (self.bits is not None and self.bits[0] == self.bits[1])

    @property
    def is_integer(self) -> bool:
        """Return whether the engineering value is a whole number: an integer type without scale and offset."""
        plain = self.scale == 1.0 and self.offset == 0.0 and self.scale_by is None
        return self.type in INTEGER_RANGES and plain

    @property
    def limits(self) -> tuple[float, float] | None:
        """Return the smallest and largest value that may be written, in engineering units; None if there are no limits."""
        if self.range is not None:
            return self.range
        if self.bits is not None:
            return 0, (1 << (self.bits[1] - self.bits[0] + 1)) - 1
        if self.type in INTEGER_RANGES:
            low, high = INTEGER_RANGES[self.type]
            a, b = low * self.scale + self.offset, high * self.scale + self.offset
            return min(a, b), max(a, b)
        return None


@dataclass(frozen=True, slots=True)
class MessageBlock:
    """A block of registers that the driver emits unaltered as one message when the tag `when` changes."""

    name: str
    at: RegisterRange
    when: str


@dataclass(frozen=True, slots=True)
class Sampled:
    """The tags that describe the samples of group `poll`: tag `count` counts them, tag `period` holds their period in seconds.

    If no new sample arrives within this period and `slack_ms` milliseconds, the values become uncertain.
    """

    count: str
    period: str
    slack_ms: int
    poll: str


@dataclass(frozen=True, slots=True)
class Box:
    """One mailbox: `at` covers one register each for sequence and length in bytes, and the payload after them.

    `ack` is the register of the acknowledged sequence.
    """

    name: str
    at: RegisterRange
    bytes: int
    ack: RegisterRange


@dataclass(frozen=True, slots=True)
class OwnFunction:
    """A function of the device that is not in the standard.

    `request` and `reply` are its data, without the function code. `sets` maps tags to the values that they hold
    afterwards, in engineering units.
    """

    name: str
    code: int
    request: bytes
    reply: bytes
    sets: tuple[tuple[Tag, float], ...] = ()


@dataclass(frozen=True, slots=True)
class Effect:
    """A side effect of reading or writing `tag`: `sets` maps tags to the values that they hold afterwards, in
    engineering units.

    If `value` is not None, only writing that value has the effect.
    """

    tag: Tag
    on_read: bool
    value: float | None
    sets: tuple[tuple[Tag, float], ...]


@dataclass(frozen=True)
class DeviceProfile:
    """A device profile with resolved addresses and defaults. Dictionaries keep the file's order."""

    path: str
    hash: str
    form: ProfileForm
    tags: dict[str, Tag]
    messages: dict[str, MessageBlock]
    sampled: Sampled | None
    inbox: Box | None
    outbox: Box | None
    gaps: tuple[RegisterRange, ...] = ()

    @property
    def name(self) -> str:
        return self.form.device

    @property
    def protocol(self) -> str:
        return self.form.protocol

    @property
    def eds_path(self) -> Path | None:
        """Return the path of the EDS that a CANopen profile names, in the profile's folder."""
        return Path(self.path).parent / self.form.eds if self.form.eds else None

    def group(self, poll: str) -> list[Tag]:
        """Return the readable tags of a poll group, in the order of the profile."""
        return [t for t in self.tags.values() if t.poll == poll and t.readable]

    @property
    def groups(self) -> list[str]:
        """Return the poll groups, in the file's order."""
        return list(dict.fromkeys(t.poll for t in self.tags.values() if t.readable))

    @property
    def command_list(self) -> frozenset[str]:
        """Return the commands that a device of this profile accepts (paper.md, ruling 12).

        They are ``read_<group>`` for each poll group, the names in `commands`, and ``set_<tag>`` for each writable tag that
        `commands` does not name. A transmitter accepts ``send`` and ``acknowledge``, a CANopen node the NMT commands.
        """
        named = set(self.form.commands.values())
        commands = {f"read_{g}" for g in self.groups} | set(self.form.commands)
        commands |= {f"set_{t.name}" for t in self.tags.values() if t.writable and t.name not in named}
        if self.inbox is not None:
            commands |= {"receive", "acknowledge", "send"}
        if self.protocol == "canopen":
            commands |= {"nmt_start", "nmt_stop", "nmt_preoperational", "nmt_reset_node", "nmt_reset_communication"}
        return frozenset(commands)

    @property
    def own_functions(self) -> dict[str, OwnFunction]:
        """Return the device-specific functions, by name."""
        return {
            name: OwnFunction(
                name,
                f.code,
                bytes.fromhex(f.request),
                bytes.fromhex(f.request if f.reply is None else f.reply),
                tuple((self.tags[tag], float(value)) for tag, value in f.sets.items()),
            )
            for name, f in self.form.functions.items()
        }

    @property
    def effects(self) -> tuple[Effect, ...]:
        """Return the side effects of reading and writing tags, in the file's order."""
        return tuple(
            Effect(
                self.tags[e.read or e.written or ""],
                e.read is not None,
                None if e.value is None else float(e.value),
                tuple((self.tags[tag], float(value)) for tag, value in e.sets.items()),
            )
            for e in self.form.effects
        )

    def command_for(self, tag: str) -> str:
        """Return the command that writes `tag`."""
        return next((c for c, t in self.form.commands.items() if t == tag), f"set_{tag}")


def resolve_address(text: int | str, numbering: str, count: int = 1) -> RegisterRange:
    """Read an address: ``30001`` / ``400001`` as printed in manuals, ``input:0`` / ``holding:0x10`` as sent.

    Raises ValueError with a sentence that names a valid form.
    """
    if isinstance(text, str) and ":" in text:
        table, _, number = text.partition(":")
        if table not in READ_FUNCTION:
            raise ValueError(f"no table {table!r}: coil, discrete, input or holding")
        if not re.fullmatch(r"[0-9]{1,5}|0x[0-9a-fA-F]{1,4}", number):
            raise ValueError(
                f"no address {number!r} in the table {table!r}: one number, such as {table}:100 or {table}:0x10"
            )
        address = int(number, 0)
        found: Table | None = table
    elif numbering == "printed" and re.fullmatch(r"[0-9]{5,6}", str(text)):
        digits = str(text)
        found = next((t for t, d in PRINTED if d == int(digits[0])), None)
        address = int(digits[1:]) - 1
    else:
        raise ValueError(
            f"address {text!r}: 00001 (coil), 10001, 30001 or 400001 as printed in manuals, or coil:0, holding:0x10 as sent"
        )
    if found is None:
        raise ValueError(
            f"address {text!r} starts with {str(text)[0]}: 0 coil, 1 discrete, 3 input, 4 holding register"
        )
    if address < 0 or address + count > 65536:
        raise ValueError(f"address {text!r} with {count} registers exceeds the table (0 to 65535 as sent)")
    return RegisterRange(found, address, count)


def resolve_gap(text: str, numbering: str) -> RegisterRange:
    """Read a gap, a range of registers that a device does not have: ``30001..30010`` as printed, ``input:0..9`` or ``input:5`` as
    sent, both ends included.

    Raises ValueError with a sentence that names a valid form.
    """
    first, dots, last = text.partition("..")
    start = resolve_address(first, numbering)
    if not dots:
        return start
    end = resolve_address(f"{start.table}:{last}" if ":" in first else last, numbering)
    if end.table != start.table or end.address < start.address:
        raise ValueError(f"range {text!r}: from the lower to the higher address of one table")
    return RegisterRange(start.table, start.address, end.end - start.address)


def gap_text(gap: RegisterRange) -> str:
    """Return a range in the notation of a profile's `gaps`, as sent; `resolve_gap` reads it."""
    last = f"..{gap.end - 1}" if gap.count > 1 else ""
    return f"{gap.table}:{gap.address}{last}"
