"""The fields of Modbus frames: header, unit ID, function, addresses in both notations, counts, data with its tags, check sum.

Clauses: AP is the Modbus Application Protocol, SL Modbus over Serial Line, TG the messaging guide for TCP/IP. The module does
no I/O.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from fieldtwin.capture.decoding.exchange import SECRET, TouchedSpan
from fieldtwin.capture.decoding.fields import FieldReader, FieldSpan
from fieldtwin.capture.decoding.modbus_pdu import (
    BIT_TABLES,
    TABLES,
    DecodedRequest,
    bits,
    exception_text,
    parse_request,
    service_of,
)
from fieldtwin.capture.decoding.tags import TagMap
from fieldtwin.gateway.core.files.profile import RegisterRange, Table
from fieldtwin.gateway.protocols.modbus.frames.crc import crc16

_CLAUSES = {
    0x01: "6.1", 0x02: "6.2", 0x03: "6.3", 0x04: "6.4", 0x05: "6.5", 0x06: "6.6", 0x07: "6.7", 0x08: "6.8", 0x0B: "6.9",
    0x0C: "6.10", 0x0F: "6.11", 0x10: "6.12", 0x11: "6.13", 0x14: "6.14", 0x15: "6.15", 0x16: "6.16", 0x17: "6.17",
    0x18: "6.18", 0x2B: "6.19",
}  # fmt: skip
_MBAP_BYTES = 7

Units = Mapping[int, TagMap]


def modbus_fields(
    framing: str, is_request: bool, data: bytes, request: bytes = b"", units: Units | None = None
) -> list[FieldSpan]:
    """Return the fields of one frame; on Modbus TCP also of several frames in a row.

    `framing` is rtu, ascii, mbap or udp; in ascii, offsets count characters. `request` is the whole frame that a reply
    answers; without it the registers of a reply have no addresses. `units` holds the tags of the devices by unit ID.
    """
    units = units or {}
    if framing == "rtu":
        return _rtu(is_request, data, _pdu_of(request[1:-2]), units)
    if framing == "ascii":
        return _ascii(is_request, data, request, units)
    return _mbap(is_request, data, request, units)


def _rtu(is_request: bool, data: bytes, asked: DecodedRequest | None, units: Units) -> list[FieldSpan]:
    reader = FieldReader(data)
    unit = _unit(reader, serial=True)
    pdu = data[1:-2]
    reader.embed(_pdu(is_request, pdu, asked, units.get(unit)), len(pdu))
    expected = crc16(data[:-2])

    def check(raw: bytes) -> str:
        if int.from_bytes(raw, "little") == expected:
            return "right"
        return f"wrong: these bytes have {expected.to_bytes(2, 'little').hex(' ')}"

    reader.take(2, "CRC", check, "Check sum of all bytes before it, low byte first (SL 2.5.1.2).")
    return reader.spans


def _ascii(is_request: bool, data: bytes, request: bytes, units: Units) -> list[FieldSpan]:
    """Return the fields of an ASCII frame: those of its binary content, each stretched to two characters for each byte."""
    end = len(data.rstrip(b"\r\n"))
    body = _from_hex(data[1:end])
    reader = FieldReader(data)
    if not data.startswith(b":") or len(body) < 3:
        reader.rest(
            "not a frame", "", "An ASCII frame is a colon, pairs of hexadecimal characters, CR and LF (SL 2.5.2)."
        )
        return reader.spans
    reader.take(1, "start", "colon", "A colon begins each frame (SL 2.5.2.1).")
    asked = _pdu_of(_from_hex(request.strip(b":\r\n"))[1:-1])
    inner = FieldReader(body)
    unit = _unit(inner, serial=True)
    inner.embed(_pdu(is_request, body[1:-1], asked, units.get(unit)), len(body) - 2)
    expected = -sum(body[:-1]) & 0xFF
    right = body[-1] == expected
    inner.take(
        1,
        "LRC",
        "right" if right else f"wrong: these bytes have {expected:02X}",
        "Check sum of the bytes before it (SL 2.5.2.2).",
    )
    spans = [FieldSpan(2 * s.offset, 2 * s.length, s.name, s.value, s.note) for s in inner.spans]
    reader.embed(spans, 2 * len(body))
    reader.rest(
        "end", lambda raw: "CR LF" if raw == b"\r\n" else "incomplete", "CR and LF end each frame (SL 2.5.2.1)."
    )
    return reader.spans


def _from_hex(text: bytes) -> bytes:
    """Return the bytes of hexadecimal characters; nothing if other characters are among them."""
    digits = b"0123456789abcdefABCDEF"
    if len(text) % 2 or any(c not in digits for c in text):
        return b""
    return bytes.fromhex(text.decode("ascii"))


def _mbap(is_request: bool, data: bytes, request: bytes, units: Units) -> list[FieldSpan]:
    reader = FieldReader(data)
    open_requests = _requests_by_transaction(request)
    while reader.left:
        head = data[len(data) - reader.left :]
        transaction = reader.number(2, "transaction ID", "The reply repeats it (TG 3.1.3).")
        protocol = reader.number(
            2, "protocol ID", "0 is Modbus (TG 3.1.3).", lambda n: "0 (Modbus)" if n == 0 else f"{n} (not Modbus)"
        )
        length = reader.number(2, "length", "The number of bytes that follow: unit ID and PDU (TG 3.1.3).")
        if protocol != 0 or not 2 <= length <= 254:
            reader.rest("not a Modbus TCP frame", "", "After an invalid header the next frame cannot be found.")
            break
        unit = _unit(reader, serial=False)
        pdu = head[_MBAP_BYTES : 6 + length]
        reader.embed(_pdu(is_request, pdu, open_requests.get(transaction), units.get(unit)), len(pdu))
    return reader.spans


def _requests_by_transaction(data: bytes) -> dict[int, DecodedRequest]:
    found: dict[int, DecodedRequest] = {}
    while len(data) > _MBAP_BYTES and (size := 6 + int.from_bytes(data[4:6])) > _MBAP_BYTES:
        found[int.from_bytes(data[:2])] = parse_request(data[_MBAP_BYTES:size])
        data = data[size:]
    return found


def _pdu_of(pdu: bytes) -> DecodedRequest | None:
    return parse_request(pdu) if pdu else None


def _unit(reader: FieldReader, *, serial: bool) -> int:
    def show(unit: int) -> str:
        if unit == 0 and serial:
            return "0 (broadcast: all devices, without a reply)"
        return f"{unit} (reserved)" if serial and unit > 247 else str(unit)

    note = (
        "The device on the line: 1 to 247 (SL 2.2)." if serial else "The device behind the server's address (TG 3.1.3)."
    )
    return reader.number(1, "unit ID", note, show)


# -- protocol data units --------------------------------------------------------------------------------------------------


def _pdu(is_request: bool, pdu: bytes, asked: DecodedRequest | None, tags: TagMap | None) -> list[FieldSpan]:
    reader = FieldReader(pdu)
    code = pdu[0] if pdu else 0
    function = code if is_request else code & 0x7F
    clause = f" (AP {_CLAUSES[function]})" if function in _CLAUSES else ""
    if not is_request and code & 0x80:
        name = f"{code:02X}h: refusal of {function:02X}h {service_of(function)}"
        reader.take(1, "function", name, "The function code with its highest bit set (AP 7).")
        reader.number(1, "exception code", "The reason of the refusal (AP 7).", exception_text)
    else:
        note = f"What the server does{clause}." if clause else "Not a function of the standard."
        reader.take(1, "function", f"{code:02X}h {service_of(function)}", note)
        _Data(reader, function, f"AP {_CLAUSES.get(function, '4.1')}", asked, tags).read(is_request)
    reader.rest("surplus bytes", "more than the function has")
    return reader.spans


class _Data:
    """The data of a PDU, after its function code."""

    def __init__(
        self, reader: FieldReader, function: int, clause: str, asked: DecodedRequest | None, tags: TagMap | None
    ) -> None:
        self._reader = reader
        self._function = function
        self._clause = clause
        self._asked = asked if asked is not None and asked.function == function else None
        self._tags = tags
        self._table: Table = TABLES.get(function, "holding")

    def read(self, is_request: bool) -> None:
        """Divide the data into the fields of the function code."""
        function = self._function
        if function in (0x01, 0x02, 0x03, 0x04):
            self._range("") if is_request else self._counted_reply()
        elif function in (0x05, 0x06, 0x16):
            self._single()
        elif function in (0x0F, 0x10):
            self._several(is_request)
        elif function == 0x17:
            self._read_write() if is_request else self._counted_reply()
        elif function in (0x07, 0x08, 0x0B, 0x18, 0x2B):
            self._special(is_request)
        elif function in (0x0C, 0x11, 0x14, 0x15):
            self._take_count()
        self._reader.rest("data", lambda raw: raw.hex(" "), f"Data of the function ({self._clause}).")

    def _range(self, which: str) -> tuple[int, int]:
        address = self._address(f"{which}address")
        count = self._reader.number(2, f"{which}count", f"The number of {self._things} ({self._clause}).")
        return address, count

    def _address(self, name: str) -> int:
        note = f"The protocol's address counts from 0, the data sheet's from 1 (AP 4.4; {self._clause})."
        return self._reader.number(2, name, note, lambda n: str(RegisterRange(self._table, n, 1)))

    @property
    def _things(self) -> str:
        return "bits" if self._table in BIT_TABLES else "registers"

    def _take_count(self) -> int:
        return self._reader.number(1, "byte count", f"The number of data bytes that follow ({self._clause}).")

    def _counted_reply(self) -> None:
        size = min(self._take_count(), self._reader.left)
        span = self._asked.read_span if self._asked else None
        self._values(None if span is None else span.address, size, span.count if span else 8 * size)

    def _single(self) -> None:
        address = self._address("address")
        if self._function == 0x06:
            self._values(address, 2, 1)
        elif self._function == 0x05:
            states = {0xFF00: "on", 0x0000: "off"}
            note = f"FF00h is on, 0000h is off ({self._clause})."
            self._reader.number(
                2, "value", note, lambda n: states.get(n, f"{n:04X}h (invalid)") + self._tag_at(address)
            )
        else:
            self._reader.number(2, "AND mask", f"Bits that are kept ({self._clause}).", "{:04X}h".format)
            self._reader.number(
                2, "OR mask", f"Values of the bits that are not kept ({self._clause}).", "{:04X}h".format
            )

    def _tag_at(self, address: int) -> str:
        found = self._tags.profile.tags.values() if self._tags else ()
        names = [t.name for t in found if t.at and t.at.table == self._table and t.at.address <= address < t.at.end]
        return f": {', '.join(names)}" if names else ""

    def _several(self, is_request: bool) -> None:
        address, count = self._range("")
        if is_request:
            self._values(address, min(self._take_count(), self._reader.left), count)

    def _read_write(self) -> None:
        self._range("read ")
        address, count = self._range("write ")
        self._values(address, min(self._take_count(), self._reader.left), count)

    def _special(self, is_request: bool) -> None:
        reader, clause = self._reader, self._clause
        if self._function == 0x07 and not is_request:
            reader.take(1, "exception status", lambda raw: f"{raw[0]:08b}", f"Eight bits of the device ({clause}).")
        elif self._function == 0x08:
            reader.number(2, "sub-function", f"Which diagnosis ({clause}).", "{:04X}h".format)
        elif self._function == 0x0B and not is_request:
            busy = {0: "ready", 0xFFFF: "still busy"}
            reader.number(
                2,
                "status",
                f"Whether an earlier command is in progress ({clause}).",
                lambda n: busy.get(n, f"{n:04X}h"),
            )
            reader.number(2, "event count", f"Successful messages that were counted ({clause}).")
        elif self._function == 0x18 and is_request:
            self._address("FIFO pointer address")
        elif self._function == 0x18:
            reader.number(2, "byte count", f"The number of bytes that follow ({clause}).")
            reader.number(2, "FIFO count", f"Registers in the queue, at most 31 ({clause}).")
        elif self._function == 0x2B:
            kinds = {0x0D: "0Dh (CANopen)", 0x0E: "0Eh (device identification)"}
            reader.number(1, "MEI type", f"The encapsulated interface ({clause}).", lambda n: kinds.get(n, f"{n:02X}h"))
            reader.number(1, "access", "Which group of objects is read (AP 6.21).", "{:02X}h".format)
            if is_request:
                reader.number(1, "object ID", "The first object (AP 6.21).", "{:02X}h".format)

    # -- values ----------------------------------------------------------------------------------------------------------

    def _values(self, address: int | None, size: int, count: int) -> None:
        if size <= 0:
            return
        if self._table in BIT_TABLES:
            self._bits(address, size, count)
        elif address is None or address < 0:
            for _ in range(size // 2):
                self._reader.number(2, "register", f"Its address is in the request ({self._clause}).", _plain)
        else:
            self._registers(address, size // 2)

    def _bits(self, address: int | None, size: int, count: int) -> None:
        for at in range(size):
            part = max(0, min(8, count - 8 * at))

            def show(raw: bytes, at: int = at, part: int = part) -> str:
                states = bits(raw, part)
                if address is None or not part:
                    return " ".join(map(str, states)) or "padding"
                span = TouchedSpan("read", self._table, address + 8 * at, part)
                named = self._tags.show(self._tags.of_registers(span, states, 0)) if self._tags else ""
                return f"{' '.join(map(str, states))}{f': {named}' if named else ''}"

            first = "" if address is None else f" from {RegisterRange(self._table, address + 8 * at, 1)}"
            self._reader.take(1, f"bits{first}", show, f"The lowest bit is the first ({self._clause}).")

    def _registers(self, address: int, count: int) -> None:
        """Take registers one by one, and those of a tag together."""
        data = self._reader.data[len(self._reader.data) - self._reader.left :][: 2 * count]
        whole = TouchedSpan("read", self._table, address, count)
        values = self._tags.of_registers(whole, data, 0) if self._tags and count else {}
        groups = _groups(self._tags, whole, values)
        at = address
        while at < address + count:
            end, names = groups.get(at, (at + 1, []))
            shown = self._shown(at, end, names, values)
            place = str(RegisterRange(self._table, at, end - at))
            note = self._note(at, end, names, place)
            self._reader.take(2 * (end - at), ", ".join(names) or place, shown, note)
            at = end

    def _shown(self, at: int, end: int, names: list[str], values: Mapping[str, object]) -> Callable[[bytes], str]:
        tags = self._tags

        def show(raw: bytes) -> str:
            if tags is None:
                return _plain(int.from_bytes(raw))
            secret = tags.secret(TouchedSpan("read", self._table, at, end - at))
            said = tags.show({name: values[name] for name in names})  # type: ignore[misc]
            if len(names) == 1:
                said = said.removeprefix(f"{names[0]} ")
            if secret:
                return said or SECRET
            return f"{said} ({raw.hex().upper()}h)" if said else _plain(int.from_bytes(raw))

        return show

    def _note(self, at: int, end: int, names: list[str], place: str) -> str:
        if names:
            return f"{place}, by the device's profile ({self._clause})."
        tags = self._tags.profile.tags.values() if self._tags else ()
        parts = [t.name for t in tags if t.at and t.at.overlaps(RegisterRange(self._table, at, end - at))]
        if parts:
            return f"Only a part of {', '.join(parts)} was transferred, so it has no value here ({self._clause})."
        return f"The profile has no tag here ({self._clause})." if self._tags else f"A register ({self._clause})."


def _groups(tags: TagMap | None, whole: TouchedSpan, values: Mapping[str, object]) -> dict[int, tuple[int, list[str]]]:
    """Group the tags that share registers: return, for each first address, the address after the group and the names of its
    tags.
    """
    if tags is None:
        return {}
    profile = tags.profile
    places = [(t.at, t.name) for t in profile.tags.values() if t.at is not None and t.name in values]
    blocks = [m for m in profile.messages.values() if m.name in values]
    places += [(m.at, m.name) for m in blocks if not any(at.overlaps(m.at) for at, _ in places)]
    groups: list[tuple[int, int, list[str]]] = []
    for at, name in sorted(places, key=lambda p: (p[0].address, p[0].end)):
        if groups and at.address < groups[-1][1]:
            start, end, names = groups[-1]
            groups[-1] = (start, max(end, at.end), [*names, name])
        else:
            groups.append((at.address, at.end, [name]))
    return {start: (end, names) for start, end, names in groups if end <= whole.address + whole.count}


def _plain(number: int) -> str:
    return f"{number} ({number:04X}h)"
