"""A Modbus device without a recording: its profile defines its registers and functions.

The cells are those of the tags; addresses between them do not exist (exception 02). Cells hold the values of the prototype file
until a client writes them; by default 0, or where the tag's range excludes 0, the nearest value in that range. The effects of
accesses, device-specific functions, identification, files and queues are as the profile states. The device changes only when it
handles a request, so this module runs no task and never waits.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence

from fieldtwin.emulators.journal import DeviceValueLog
from fieldtwin.emulators.modbus.bank import IllegalValue, MapBank, RegisterBank, Table
from fieldtwin.emulators.modbus.unit import Handler, ModbusUnit
from fieldtwin.emulators.stated import Effects, bytes_of, cells_held, cells_of, fits, merged, spans_of, touches
from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.core.files.profile import DeviceProfile, OwnFunction, Tag

_BITS = {"true": 1.0, "false": 0.0}
_WHOLE = re.compile(r"[1-9][0-9]{0,18}|0|0x[0-9a-fA-F]{1,16}")


class ProfileRegisters(RegisterBank):
    """The registers of a device by its profile. `values` maps tags to initial values, in engineering units or as text."""

    def __init__(self, profile: DeviceProfile, values: Mapping[str, float | str], now_ns: int) -> None:
        for name in values:
            if name not in profile.tags:
                known = ", ".join(profile.tags)
                raise FileInvalid(f"{profile.name} has no tag {name!r}", path=profile.path, expected=known)
        self.journal = DeviceValueLog()
        self._tags = [tag for tag in profile.tags.values() if tag.readable]
        self._cells = MapBank(spans_of(profile), undeclared=profile.form.undeclared)
        self._effects = Effects(profile.effects)
        self._exponents = {t.name: _exponent(t, values) for t in profile.tags.values()}
        self._start_in_range(profile, values)
        for name, value in values.items():
            tag = profile.tags[name]
            number = _number(tag, value) if isinstance(value, str) != (tag.type == "string") else value
            if not fits(tag, number, self._exponents[name]):
                expected = f"what {tag.registers.count} registers of type {tag.type} can hold"
                raise FileInvalid(f"the value of {name!r}", path=profile.path, expected=expected, got=repr(value))
            self._put(tag, value)
        for tag in self._tags:
            self._note(tag, now_ns)

    def _start_in_range(self, profile: DeviceProfile, given: Collection[str]) -> None:
        """Give each tag whose range excludes 0 a value in that range. For example, no device has the unit ID 0."""
        for tag in profile.tags.values():
            if tag.range is not None and tag.name not in given and not tag.is_text:
                low, high = tag.range
                if not low <= tag.offset <= high:
                    self._put(tag, low if tag.offset < low else high)

    def read(self, table: Table, address: int, count: int, now_ns: int) -> Sequence[int]:
        values = self._cells.read(table, address, count, now_ns)
        self.set(self._effects.of(table, range(address, address + count), None), now_ns)
        return values

    def check_read(self, table: Table, address: int, count: int, now_ns: int) -> None:
        self._cells.check_read(table, address, count, now_ns)

    def write(self, table: Table, address: int, values: Sequence[int], now_ns: int) -> None:
        self._cells.write(table, address, values, now_ns)
        addresses = range(address, address + len(values))
        self._note_all(table, addresses, now_ns)
        self.set(self._effects.of(table, addresses, values), now_ns)

    def set(self, sets: Sequence[tuple[Tag, float]], now_ns: int) -> None:
        """Set tags to new values that the device itself determines, in order."""
        for tag, value in sets:
            self._put(tag, value)
            at = tag.registers
            self._note_all(at.table, range(at.address, at.end), now_ns)

    def peek(self, table: Table, address: int) -> int:
        """Return the value of a cell without the effects that the profile declares for a read."""
        return self._cells.peek(table, address)

    def _put(self, tag: Tag, value: float | str) -> None:
        at = tag.registers
        if isinstance(value, str) != (tag.type == "string"):
            value = _number(tag, value)
        cells = cells_of(tag, value, self._exponents[tag.name])
        if tag.bits is not None:
            cells = [merged(tag, self._cells.peek(at.table, at.address), cells[0])]
        self._cells.poke(at.table, at.address, *cells)

    def _note_all(self, table: Table, addresses: range, now_ns: int) -> None:
        for tag in self._tags:
            if touches(tag, table, addresses):
                self._note(tag, now_ns)

    def _note(self, tag: Tag, now_ns: int) -> None:
        self.journal.note(tag.name, bytes_of(tag, cells_held(tag, self._cells.peek)), now_ns)


def add_own_functions(unit: ModbusUnit, bank: ProfileRegisters, profile: DeviceProfile) -> None:
    """Let `unit` answer every device-specific function of the profile.

    The unit answers the documented request of each function, and gives exception 03 to all other requests.
    """
    for function in profile.own_functions.values():
        unit.register(function.code, _handler(bank, function), request_length=1 + len(function.request))


def _handler(bank: ProfileRegisters, function: OwnFunction) -> Handler:
    def respond(pdu: bytes, now_ns: int) -> bytes:
        if pdu[1:] != function.request:
            raise IllegalValue(f"{function.name}: {pdu[1:].hex(' ')}")
        bank.set(function.sets, now_ns)
        return pdu[:1] + function.reply

    return respond


def _exponent(tag: Tag, values: Mapping[str, float | str]) -> int:
    """Return the initial value of the scale-factor register of `tag`; 0 if it has none."""
    held = values.get(tag.scale_by, 0) if tag.scale_by is not None else 0
    return 0 if isinstance(held, str) else int(held)


def _number(tag: Tag, text: float | str) -> float:
    """Return the number for a value that is given as text: a name that the profile defines, true or false, or an integer.

    Raises `FileInvalid` for any other value.
    """
    for number, word in tag.values:
        if word == text:
            return number * tag.scale + tag.offset
    if tag.is_bit and text in _BITS:
        return _BITS[str(text)]
    if isinstance(text, str) and not tag.is_text and _WHOLE.fullmatch(text):
        return float(int(text, 0))  # an identity is text, for any type of the register
    expected = ", ".join(word for _, word in tag.values) or ("true or false" if tag.is_bit else "a number")
    if tag.is_text:
        expected = "text" if tag.type == "string" else "none: bytes cannot be stated"
    raise FileInvalid(f"the value of {tag.name!r}", expected=expected, got=repr(text))
