"""Read the file of a device profile: convert it to a `DeviceProfile`, and check the rules that the schema cannot express."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable
from pathlib import Path

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.core.files.profile import (
    BIT_TABLES,
    READ_FUNCTION,
    REGISTERS_OF,
    Box,
    DeviceProfile,
    MessageBlock,
    RegisterRange,
    Sampled,
    Table,
    Tag,
    resolve_address,
    resolve_gap,
)
from fieldtwin.gateway.core.files.profile_schema import BoxForm, MessageForm, ProfileForm, TagForm
from fieldtwin.gateway.core.files.yaml_file import Key, YamlFile, load, validate

_WHOLE_OBJECT = (
    "name the values of the whole object with `values`; a program takes its bits: declare a BYTE, WORD or DWORD, and use "
    "`outputs AND 1`"
)
"""The alternative to several tags of one CANopen object, which is one value in a PDO and in an SDO (CiA 301, 7.2.2 and 7.2.4)."""


def load_profile(path: Path) -> DeviceProfile:
    """Read a profile. Raises `FileInvalid` with line and column for every error."""
    return resolve(load(path))


def resolve(file: YamlFile) -> DeviceProfile:
    """Return a parsed profile file as a `DeviceProfile`."""
    form = validate(file, ProfileForm)
    tags: dict[str, Tag] = {}
    by_object: dict[tuple[int, int], Tag] = {}
    for name, tag_form in form.tags.items():
        for tag in _tags_of(file, form, name, tag_form):
            if tag.name in tags:
                raise file.error(("tags", name), f"the tag {tag.name!r} is defined twice")
            tags[tag.name] = tag
            if tag.object is not None and (first := by_object.setdefault(tag.object, tag)) is not tag:
                index, subindex = tag.object
                raise file.error(
                    ("tags", name, "object"),
                    f"the object {index:04X}h:{subindex:02X} already has the tag {first.name!r}",
                    expected="one tag for each object",
                    hint=_WHOLE_OBJECT,
                )
    profile = DeviceProfile(
        path=file.path,
        hash=hashlib.sha256(form.model_dump_json(exclude_defaults=True).encode()).hexdigest()[:16],
        form=form,
        tags=tags,
        messages={n: _message(file, form, n, m) for n, m in form.messages.items()},
        sampled=Sampled(**form.sampled.model_dump()) if form.sampled else None,
        inbox=_box(file, form, "inbox", form.mailbox.inbox) if form.mailbox else None,
        outbox=_box(file, form, "outbox", form.mailbox.outbox) if form.mailbox else None,
        gaps=tuple(_gap(file, form, i, text) for i, text in enumerate(form.gaps)),
    )
    _check_references(file, profile)
    return profile


def _tags_of(file: YamlFile, form: ProfileForm, name: str, t: TagForm) -> Iterable[Tag]:
    """Return the tag of a name, or several adjacent tags for a name such as ``voltage_l1..3``."""
    loc: tuple[Key, ...] = ("tags", name)
    kind = t.type or form.defaults.type
    if form.protocol == "canopen":
        if t.object is None or t.at is not None:
            raise file.error(loc, f"the tag {name!r} of a CANopen device", expected='`object: "6010:00"`, and no `at`')
        first, last = None, 0
        indexes = (int(t.object[:4], 16), int(t.object[5:], 16))
    else:
        if t.at is None or t.object is not None:
            raise file.error(loc, f"the tag {name!r} of a Modbus device", expected="`at: 30001`, and no `object`")
        if _table(form, t.at) in BIT_TABLES:
            if (t.type or "bool") != "bool":
                raise file.error((*loc, "type"), f"the tag {name!r} is a single bit", expected="bool", got=str(t.type))
            kind = "bool"
        if kind in ("int8", "uint8"):
            raise file.error((*loc, "type"), f"the tag {name!r} is an {kind}", expected="16 bits at least: a register")
        if kind in ("string", "bytes") and t.registers is None:
            raise file.error(loc, f"the tag {name!r} is a {kind}", expected="`registers: N`, its length")
        first = _address(file, (*loc, "at"), form, t.at, t.registers or REGISTERS_OF[kind])
        indexes = None
    if t.bits is not None:
        _check_bits(file, loc, form, kind, t.bits)
    match = re.fullmatch(r"(.*?)([0-9]+)\.\.([0-9]+)", name)
    names = [name]
    if match:
        start, last = int(match[2]), int(match[3])
        names = [f"{match[1]}{n}" for n in range(start, last + 1)]
    for i, single in enumerate(names):
        at = None
        if first is not None:
            step = first.count
            at = RegisterRange(first.table, first.address + i * step, step)
        yield Tag(
            name=single,
            type=kind,
            at=at,
            object=(indexes[0], indexes[1] + i) if indexes else None,
            order=t.order or form.defaults.order,
            poll=t.poll or form.defaults.poll,
            access=t.access,
            unit=t.unit,
            scale=t.scale,
            offset=t.offset,
            values=tuple((t.values or {}).items()),
            range=t.range,
            counter=t.counter,
            secret=t.secret,
            danger=t.danger,
            scale_by=t.scale_by,
            bits=t.bits,
            sentinels=tuple(t.sentinels),
            nonvolatile=t.nonvolatile,
        )


def _check_bits(file: YamlFile, loc: tuple[Key, ...], form: ProfileForm, kind: str, bits: tuple[int, int]) -> None:
    name, (low, high) = str(loc[-1]), bits
    if form.protocol == "canopen":
        raise file.error(
            (*loc, "bits"),
            f"{name!r} is a part of a CANopen object",
            expected="a tag of the whole object",
            hint=_WHOLE_OBJECT,
        )
    if kind not in ("uint16", "bool") or not 0 <= low <= high <= 15:
        raise file.error(
            (*loc, "bits"), f"the bits of {name!r}", expected="type uint16 or bool, and [low, high] within 0 to 15"
        )
    if kind == "bool" and low != high:
        raise file.error((*loc, "bits"), f"the tag {name!r} is a bool", expected=f"one bit, [{low}, {low}]")


def _address(file: YamlFile, loc: tuple[Key, ...], form: ProfileForm, at: int | str, count: int) -> RegisterRange:
    try:
        return resolve_address(at, form.numbering, count)
    except ValueError as e:
        raise file.error(loc, str(e)) from e


def _table(form: ProfileForm, at: int | str) -> Table | None:
    """Return the table of an address, or None if the address is invalid."""
    try:
        return resolve_address(at, form.numbering, 1).table
    except ValueError:
        return None


def _register_address(
    file: YamlFile, loc: tuple[Key, ...], form: ProfileForm, at: int | str, count: int
) -> RegisterRange:
    """Return the address of `count` registers. Raises `FileInvalid` for the address of a coil or a discrete input."""
    if _table(form, at) in BIT_TABLES:
        got = resolve_address(at, form.numbering, 1)
        raise file.error(loc, "a single bit", expected="a holding or input register", got=f"{got.table}:{got.address}")
    return _address(file, loc, form, at, count)


def _gap(file: YamlFile, form: ProfileForm, i: int, text: str) -> RegisterRange:
    try:
        return resolve_gap(text, form.numbering)
    except ValueError as e:
        raise file.error(("gaps", i), str(e)) from e


def _message(file: YamlFile, form: ProfileForm, name: str, m: MessageForm) -> MessageBlock:
    return MessageBlock(name, _register_address(file, ("messages", name, "at"), form, m.at, m.registers), m.when)


def _box(file: YamlFile, form: ProfileForm, name: str, box: BoxForm) -> Box:
    at = _register_address(file, ("mailbox", name, "at"), form, box.at, 2 + (box.bytes + 1) // 2)
    ack = _register_address(file, ("mailbox", name, "ack"), form, box.ack, 1)
    return Box(name, at, box.bytes, ack)


WRITE_FUNCTIONS: dict[Table, tuple[int, ...]] = {"coil": (5, 15), "holding": (6, 16), "discrete": (), "input": ()}


def _check_functions(file: YamlFile, p: DeviceProfile) -> None:
    """Check that the device has the functions to read every value, and to write every value that is marked as writable."""
    functions = p.form.limits.functions
    for tag in p.tags.values():
        if tag.at is None:
            continue
        table, loc = tag.at.table, ("tags", tag.name)
        if tag.readable and functions is not None and READ_FUNCTION[table] not in functions:
            raise file.error(
                loc,
                f"the value {tag.name!r} is read with a function that the device does not have",
                expected=f"{READ_FUNCTION[table]} in `limits: functions`",
            )
        if not tag.writable:
            continue
        if not WRITE_FUNCTIONS[table]:
            raise file.error(loc, f"the value {tag.name!r} cannot be written: it is in the table {table!r}")
        usable = [f for f in WRITE_FUNCTIONS[table] if functions is None or f in functions]
        if not usable or (usable == [6] and tag.at.count > 1):
            needed = "16" if tag.at.count > 1 else " or ".join(str(f) for f in WRITE_FUNCTIONS[table])
            raise file.error(
                loc,
                f"the value {tag.name!r} is written with a function that the device does not have",
                expected=f"{needed} in `limits: functions`",
            )


def _check_reads(file: YamlFile, p: DeviceProfile) -> None:
    """Check that one value, message or sample fits into one read, and that a sample's counter can count."""
    most = p.form.limits.read_registers
    for tag in p.tags.values():
        if tag.at is not None and tag.readable and tag.at.count > most:
            raise file.error(
                ("tags", tag.name),
                f"the value {tag.name!r} cannot be read at once",
                expected=f"at most {most} registers (`limits: read_registers`)",
                got=str(tag.at.count),
            )
        for i, gap in enumerate(p.gaps):
            if tag.at is not None and tag.at.overlaps(gap):
                raise file.error(("gaps", i), f"the gap {p.form.gaps[i]!r} overlaps the tag {tag.name!r}")
    for message in p.messages.values():
        if message.at.count > most:
            raise file.error(
                ("messages", message.name),
                f"the message {message.name!r} cannot be read at once",
                expected=f"at most {most} registers (`limits: read_registers`)",
                got=str(message.at.count),
            )
    if p.sampled is None:
        return
    count = p.tags[p.sampled.count]
    if not count.is_integer:
        raise file.error(("sampled", "count"), f"the counter {count.name!r}", expected="a whole number, without scale")
    if count.poll != p.sampled.poll:
        raise file.error(
            ("sampled",),
            f"the counter {count.name!r} is not read with {p.sampled.poll!r}",
            expected=f"poll: {count.poll}",
        )


def _check_sets(file: YamlFile, p: DeviceProfile, loc: tuple[Key, ...], sets: Iterable[str]) -> None:
    for tag in sets:
        if p.tags[tag].bits is not None or p.tags[tag].is_text:
            raise file.error((*loc, "sets", tag), f"{tag!r} is text, or a part of a register")


def _check_stated(file: YamlFile, p: DeviceProfile) -> None:
    """Check that the device has the access and the function codes that its effects, identification, files and FIFOs need."""
    for i, effect in enumerate(p.effects):
        if not (effect.tag.readable if effect.on_read else effect.tag.writable):
            verb = "read" if effect.on_read else "written"
            raise file.error(
                ("effects", i), f"the tag {effect.tag.name!r} is never {verb}", expected="another `access`"
            )
        _check_sets(file, p, ("effects", i), p.form.effects[i].sets)
    form, allowed = p.form, p.form.limits.functions
    stated: list[tuple[str, int, object]] = [
        ("server_id", 0x11, form.server_id),
        ("identification", 0x2B, form.identification),
        ("files", 0x14, form.files),
        ("fifos", 0x18, form.fifos),
    ]
    for key, code, said in stated:
        if said and allowed is not None and code not in allowed:
            raise file.error((key,), f"function {code:02X}h is not in `limits: functions`", expected=str(code))
    basic = {0: "0 (vendor)", 1: "1 (product code)", 2: "2 (revision)"}
    if form.identification and (
        missing := [name for number, name in basic.items() if number not in form.identification]
    ):
        raise file.error(
            ("identification",),
            f"`identification` has no {' and no '.join(missing)}",
            expected="the texts of the objects 0, 1 and 2, which every device with function 2Bh/0Eh has",
        )


def _check_references(file: YamlFile, p: DeviceProfile) -> None:
    """Check that every tag that the profile refers to exists and is of the required kind."""
    wanted: list[tuple[tuple[Key, ...], str]] = [(("commands", c), t) for c, t in p.form.commands.items()]
    wanted += [(("messages", m.name, "when"), m.when) for m in p.messages.values()]
    wanted += [(("identify", i, "tag"), e.tag) for i, e in enumerate(p.form.identify)]
    wanted += [(("tags", t.name, "scale_by"), t.scale_by) for t in p.tags.values() if t.scale_by is not None]
    wanted += [(("functions", n, "sets", t), t) for n, f in p.form.functions.items() for t in f.sets]
    for i, effect in enumerate(p.form.effects):
        wanted += [(("effects", i), effect.read or effect.written or "")]
        wanted += [(("effects", i, "sets", t), t) for t in effect.sets]
    if p.form.trigger is not None:
        wanted.append((("trigger", "tag"), p.form.trigger.tag))
    if p.sampled:
        wanted += [(("sampled", "count"), p.sampled.count), (("sampled", "period"), p.sampled.period)]
    for loc, tag in wanted:
        if tag not in p.tags:
            raise file.error(loc, f"no tag {tag!r} in this profile", expected="one of " + ", ".join(p.tags))
    _check_reads(file, p)
    _check_functions(file, p)
    for command, tag in p.form.commands.items():
        if not p.tags[tag].writable:
            raise file.error(("commands", command), f"the tag {tag!r} is read-only", expected="`access: rw` or `wo`")
    for name, behaviour in p.form.behaviours.items():
        for command in behaviour:
            if command not in p.form.commands:
                raise file.error(
                    ("behaviours", name, command),
                    f"no command {command!r}",
                    expected=", ".join(p.form.commands) or "none",
                )
    for name, function in p.form.functions.items():
        allowed = p.form.limits.functions
        if allowed is not None and function.code not in allowed:
            raise file.error(("functions", name, "code"), f"{function.code:02X}h is not in `limits: functions`")
        if max(len(t) for t in (function.request, function.reply or "")) > 3 * 252:
            raise file.error(("functions", name), "more data than a PDU holds", expected="at most 252 bytes")
        _check_sets(file, p, ("functions", name), function.sets)
    _check_stated(file, p)
    if p.protocol == "canopen" and p.form.eds is None:
        raise FileInvalid("a CANopen profile needs an EDS", path=p.path, line=1, expected="`eds: FILE.eds`")
