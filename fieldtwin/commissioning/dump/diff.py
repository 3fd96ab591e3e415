"""Compare two dumps, or a dump with a profile or an EDS. Differences are named where names are known.

The module does no I/O. A difference is something in which two devices of one kind, or a device and its profile, should agree
and do not. Other facts that the user should know are notes.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase

from fieldtwin.commissioning.access.address import tag_of_entry
from fieldtwin.commissioning.access.point import PointValue, decoded
from fieldtwin.commissioning.access.reading import text_of
from fieldtwin.commissioning.dump.coverage import INVALID, REFUSED, SILENT
from fieldtwin.commissioning.dump.file import Cell, Dump, Pass
from fieldtwin.commissioning.dump.profile import ProfileSweep, dumped_tags
from fieldtwin.gateway.core.errors import FieldtwinError
from fieldtwin.gateway.core.files.profile import READ_FUNCTION, DeviceProfile, RegisterRange, Tag
from fieldtwin.gateway.core.values import Reason, TagValue
from fieldtwin.gateway.devices.codec import apply_scale
from fieldtwin.gateway.protocols.canopen.eds.datatypes import LengthMismatch, decode
from fieldtwin.gateway.protocols.canopen.eds.dictionary import ObjectDictionary

NOT_THERE = 0x0602_0000
NOTHING_WRONG = (0x0800_0024, 0x0800_0022, 0x0800_0021)
"""SDO abort codes that mean "no data now" or "not in this state", which show that the object exists."""


@dataclass(frozen=True, slots=True)
class DumpDifference:
    """A difference of the tag, object or property `name` at the address `at`: the two sides and the kind of the difference."""

    kind: str
    name: str
    at: str
    left: str
    right: str


@dataclass
class Differences:
    """The result of a comparison.

    `compared` counts the values and objects that were compared, `notes` are remarks that are not differences.
    """

    found: list[DumpDifference] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    compared: int = 0


@dataclass(frozen=True, slots=True)
class Leave:
    """The exclusions of a comparison.

    Excluded are tags whose name matches a pattern in `ignore`, numbers that differ by less than `tolerance` (by name,
    then by ``*``), and with `settings` everything that cannot be written.
    """

    ignore: tuple[str, ...] = ()
    tolerance: Mapping[str, float] = field(default_factory=dict)
    settings: bool = False

    def leaves(self, tag: Tag) -> bool:
        ignored = any(fnmatchcase(tag.name, pattern) for pattern in self.ignore)
        return ignored or tag.secret or (self.settings and not tag.writable)

    def near(self, tag: Tag, left: TagValue, right: TagValue) -> bool:
        """Return whether two values are equal within the tolerance."""
        if left.raw == right.raw:
            return True
        room = next((self.tolerance[n] for n in (tag.name, "*") if n in self.tolerance), None)
        numbers = isinstance(left.value, int | float) and isinstance(right.value, int | float)
        return room is not None and numbers and abs(left.value - right.value) <= room  # type: ignore[operator]


def diff_dumps(
    left: Dump,
    right: Dump,
    profile: DeviceProfile | None = None,
    dictionary: ObjectDictionary | None = None,
    leave: Leave | None = None,
) -> Differences:
    """Compare the values in the last passes of two dumps, and the limits and functions of the two devices."""
    leave, out = leave or Leave(), Differences()
    one, other = left.passes[-1], right.passes[-1]
    tags = _tags(profile, dictionary)
    named: set[Cell] = set()
    alone = 0
    for tag in tags:
        cells = cells_of(tag)
        named.update(cells)
        if leave.leaves(tag):
            continue
        a, b = value_in(one, tag, profile), value_in(other, tag, profile)
        if a is None and b is None:
            continue
        if a is None or b is None:
            if not _refused(left if a is None else right, cells):
                alone += 1
                continue
            out.found.append(DumpDifference("not in both", tag.name, place(tag), _shown(tag, a), _shown(tag, b)))
        elif not leave.near(tag, a, b):
            out.found.append(DumpDifference("value", tag.name, place(tag), _shown(tag, a), _shown(tag, b)))
        out.compared += 1
    if not leave.settings:
        alone += _diff_unnamed(out, left, right, named, leave)
    if alone:
        out.notes.append(f"{alone} values are only in one dump: the other one did not read them or got no valid reply")
    _diff_access(out, left, right)
    return out


def diff_profile(dump: Dump, profile: DeviceProfile, leave: Leave | None = None) -> Differences:
    """Compare a Modbus profile with a dump: whether its tags exist, their values are plausible, and its limits hold."""
    leave, out, last = leave or Leave(), Differences(), dump.passes[-1]
    asked = set(dumped_tags(profile)[0])
    named: set[Cell] = set()
    for tag in profile.tags.values():
        named.update(cells_of(tag))
        if leave.leaves(tag) or tag not in asked:
            continue
        out.compared += 1
        value = value_in(last, tag, profile)
        if value is None:
            if not _refused(dump, cells_of(tag)):
                out.notes.append(f"{tag.name} ({place(tag)}) {_why_not(dump, cells_of(tag))}")
                continue
            out.found.append(DumpDifference("not there", tag.name, place(tag), "cannot be read", "read by the profile"))
        else:
            out.found += _implausible(tag, value)
    _diff_limits(out, dump, profile)
    unnamed = spans(c for c in last.cells if c not in named and last.cells[c].strip(b"\0"))
    if unnamed:
        more = f" and {len(unnamed) - 12} more" if len(unnamed) > 12 else ""
        out.notes.append(f"no tag for {', '.join(unnamed[:12])}{more}, which hold something")
    return out


def diff_dictionary(dump: Dump, dictionary: ObjectDictionary) -> Differences:
    """Compare a node's EDS with a dump: whether objects exist with the size of their type, and constants have the stated
    values.
    """
    out, last = Differences(), dump.passes[-1]
    for entry in dictionary:
        cell = (entry.index, entry.subindex)
        at = f"{entry.index:04X}h:{entry.subindex:02X}"
        if not entry.readable or (cell not in last.cells and cell not in last.refused):
            continue
        out.compared += 1
        if cell not in last.cells:
            code = last.refused[cell]
            if code in NOTHING_WRONG:
                continue
            said = "not there" if code == NOT_THERE else "refused"
            out.found.append(
                DumpDifference(said, entry.name, at, f"aborted with {code:08X}h", f"{entry.access} in the EDS")
            )
            continue
        raw = last.cells[cell]
        try:
            value = decode(entry.type_code, raw)
        except LengthMismatch as e:
            out.found.append(DumpDifference("length", entry.name, at, f"{len(raw)} bytes", e.expected))
            continue
        if entry.access == "const" and entry.default is not None and value != entry.default:
            out.found.append(DumpDifference("constant", entry.name, at, str(value), str(entry.default)))
    unknown = [c for c in last.cells if c not in dictionary.entries]
    if unknown:
        first = ", ".join(f"{i:04X}h:{s:02X}" for i, s in sorted(unknown)[:8])
        out.notes.append(f"{len(unknown)} objects that are not in the EDS: {first}")
    return out


# -- values -------------------------------------------------------------------------------------------------------


def cells_of(tag: Tag) -> list[Cell]:
    """Return the registers or the object that hold a tag."""
    if tag.at is not None:
        return [(tag.at.table, a) for a in range(tag.at.address, tag.at.end)]
    assert tag.object is not None
    return [tag.object]


def value_in(one: Pass, tag: Tag, profile: DeviceProfile | None) -> TagValue | None:
    """Return a tag's value in a pass, scaled by its scale factor; None where registers or bytes of it are missing."""
    cells = cells_of(tag)
    if not all(c in one.cells for c in cells):
        return None
    try:
        value = decoded(tag, b"".join(one.cells[c] for c in cells), 1)
    except FieldtwinError:
        return None
    if tag.scale_by is not None and profile is not None:
        return apply_scale(tag, value, value_in(one, profile.tags[tag.scale_by], profile))
    return value


def place(tag: Tag) -> str:
    """Return the address of a tag as sent on the bus: ``holding:4``, ``6041h:00``."""
    if tag.at is not None:
        return f"{tag.at.table}:{tag.at.address}"
    assert tag.object is not None
    return f"{tag.object[0]:04X}h:{tag.object[1]:02X}"


def spans(cells: Iterable[Cell]) -> list[str]:
    """Return texts such as ``holding:0..3``, one for each range of neighbouring cells."""
    runs: list[tuple[Cell, int]] = []
    for table, number in sorted(cells, key=lambda c: (str(c[0]), c[1])):
        if runs and runs[-1][0][0] == table and runs[-1][0][1] + runs[-1][1] == number:
            runs[-1] = (runs[-1][0], runs[-1][1] + 1)
        else:
            runs.append(((table, number), 1))  # type: ignore[arg-type]
    return [
        (f"{t}:{n}" if isinstance(t, str) else f"{t:04X}h:{n:02X}") + (f"..{n + c - 1}" if c > 1 else "")
        for (t, n), c in runs
    ]


def _tags(profile: DeviceProfile | None, dictionary: ObjectDictionary | None) -> list[Tag]:
    tags = [t for t in profile.tags.values() if t.readable] if profile is not None else []
    known = {t.object for t in tags}
    if dictionary is not None:
        tags += [tag_of_entry(e) for e in dictionary if e.readable and (e.index, e.subindex) not in known]
    return tags


def _shown(tag: Tag, value: TagValue | None) -> str:
    return "-" if value is None else f"{text_of(tag, PointValue(value))} {tag.unit}".rstrip()


def _diff_unnamed(out: Differences, left: Dump, right: Dump, named: set[Cell], leave: Leave) -> int:
    """Compare registers and objects without a name by their bytes. Return how many have a value in only one of the dumps."""
    one, other, alone = left.passes[-1], right.passes[-1], 0
    for cell in sorted((one.cells.keys() | other.cells.keys()) - named, key=lambda c: (str(c[0]), c[1])):
        name = spans([cell])[0]
        if any(fnmatchcase(name, pattern) for pattern in leave.ignore):
            continue
        a, b = one.cells.get(cell), other.cells.get(cell)
        if (a is None or b is None) and not _refused(left if a is None else right, [cell]):
            alone += 1
            continue
        out.compared += 1
        if a != b:
            kind = "value" if a is not None and b is not None else "not in both"
            out.found.append(DumpDifference(kind, name, name, _hex(a), _hex(b)))
    return alone


def _hex(raw: bytes | None) -> str:
    if raw is None:
        return "-"
    return f"{raw.hex()}h" + (f" ({int.from_bytes(raw)})" if len(raw) == 2 else "")


def _implausible(tag: Tag, value: TagValue) -> list[DumpDifference]:
    if value.reason in (Reason.OUT_OF_RANGE, Reason.NOT_A_NUMBER):
        limits = f"{tag.range[0]:g} to {tag.range[1]:g} {tag.unit}".rstrip() if tag.range else f"a {tag.type}"
        return [DumpDifference(str(value.reason), tag.name, place(tag), _shown(tag, value), limits)]
    states = dict(tag.values)
    if states and isinstance(value.value, int) and value.value not in states:
        names = ", ".join(f"{n} {text}" for n, text in states.items())
        return [DumpDifference("unknown state", tag.name, place(tag), str(value.value), names)]
    return []


def _refused(dump: Dump, cells: Sequence[Cell]) -> bool:
    """Return whether the device refused a request for one of `cells`.

    Silence, an invalid reply and cells that were not requested do not count.
    """
    if any(c in dump.passes[-1].refused for c in cells) or any(dump.state_of(c) == REFUSED for c in cells):
        return True
    line = dump.maps.get(str(cells[0][0]))
    return line is not None and bool(line.get("function_refused"))


def _why_not(dump: Dump, cells: Sequence[Cell]) -> str:
    """Return, in words, why a dump has no value of `cells` although the device did not refuse them."""
    states = {dump.state_of(c) for c in cells}
    return {INVALID: "got no valid reply", SILENT: "got no reply"}.get(max(states), "was not asked for")


# -- access -------------------------------------------------------------------------------------------------------


def _diff_access(out: Differences, left: Dump, right: Dump) -> None:
    """Compare the longest read of each table and the functions, if both dumps contain them."""
    for table in left.maps.keys() & right.maps.keys():
        a, b = left.maps[table], right.maps[table]
        if a.get("limit_proved") and b.get("limit_proved") and a["max_read"] != b["max_read"]:
            out.found.append(DumpDifference("longest read", table, "", str(a["max_read"]), str(b["max_read"])))
    for number in sorted(left.functions.keys() & right.functions.keys()):
        had, has = _access(left.functions[number]), _access(right.functions[number])
        if had != has:
            out.found.append(DumpDifference("function", f"{number:02X}h", "", had, has))


def _access(line: Mapping[str, object]) -> str:
    if "code" in line:
        return f"refused with {line['code']:02X}h"
    return "answers" if "hex" in line else "no valid reply" if "invalid" in line else "no reply"


def _diff_limits(out: Differences, dump: Dump, profile: DeviceProfile) -> None:
    """Add a difference for each read that the profile's driver would send and the device refuses."""
    limits = profile.form.limits
    for table, line in dump.maps.items():
        longest = int(line.get("max_read") or 0)
        words = table in ("holding", "input")
        if words and line.get("limit_proved") and longest < limits.read_registers:
            said = f"{limits.read_registers} in `limits: read_registers`"
            out.found.append(DumpDifference("longest read", table, "", str(longest), said))
        function = READ_FUNCTION[table]  # type: ignore[index]
        if limits.functions is not None and function in limits.functions and "01" in line.get("codes", {}):
            out.found.append(DumpDifference("function", f"{function:02X}h", "", "not there", "in `limits: functions`"))
    holes = [h for table in dump.maps for h in dump.holes(table)]
    sweep = ProfileSweep(profile, dumped_tags(profile)[0])
    for read in sweep.plan.reads:
        over = [h for h in holes if h.table == read.range.table and _within(h, read.range)]
        if over and not any(h.overlaps(t.registers) for h in over for t in read.tags):
            first = over[0]
            missing = f"no read over {first}"
            out.found.append(
                DumpDifference("gap", ", ".join(t.name for t in read.tags[:3]), str(first), "refused", missing)
            )


def _within(inner: RegisterRange, outer: RegisterRange) -> bool:
    return outer.address <= inner.address and inner.address < outer.end
