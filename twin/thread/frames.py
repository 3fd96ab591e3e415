"""The frames that the two ends of a thread exchange, and their encoding, which is compact enough for an acoustic modem.

A stream is the log of one origin, as it is sent to the other twin. Frames identify it by a tag of two bytes, which a HELLO
defines. An event takes 8 to 10 bytes: names are numbers in a schema that both ends derive from the system file, times
are differences, and a value takes only the bytes that it needs. Values are not rounded: the received event equals the logged one.

    HELLO    tag, schema id, origin, first and last number of the log, whether from a prototype
    DATA     tag, first number, time, events with consecutive numbers
    PIECE    tag, number, count, index, part of a DATA frame that is too large for the carrier
    ACK tag, number up to which every event is stored, then lengths of the gaps and runs after it
    LOST     tag, first and last number of events that are no longer in the log
    ASK      tag that the receiver does not know: requests a HELLO
    REFUSED  tag, id of a schema that the receiver does not have

This module uses no clock and no network.
"""

from __future__ import annotations

import hashlib
import struct
from collections import OrderedDict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from fieldtwin.gateway.core.errors import Bug, Desync
from fieldtwin.gateway.store.event import MAX_VALUE_BYTES, Event, Value

VERSION = 1
TAG_BYTES = 2
SCHEMA_BYTES = 4
SMALLEST_MTU = 32
MAX_EVENTS = 1000
MAX_ORIGIN = 80
MAX_RUNS = 64
MAX_PIECES = 256
PARTIAL = 8
"""Number of incomplete frames that are kept until their remaining pieces arrive."""

HELLO, DATA, PIECE, ACK, LOST, ASK, REFUSED = range(1, 8)
_NONE, _INT, _FLOAT32, _FLOAT64, _TEXT, _BYTES = range(6)
_F32, _F64 = struct.Struct(">f"), struct.Struct(">d")


@dataclass(frozen=True, slots=True)
class Schema:
    """The names that both ends of a system's thread know, in the same order. `id` identifies the list."""

    names: tuple[str, ...]
    system: str = ""

    @property
    def id(self) -> bytes:
        """Return the first bytes of a SHA-256 over the version of this encoding, the system and the names.

        Two plants of the same design therefore have different schemas.
        """
        whole = "\n".join((str(VERSION), self.system, *self.names))
        return hashlib.sha256(whole.encode()).digest()[:SCHEMA_BYTES]


@dataclass(frozen=True, slots=True)
class Hello:
    origin: str
    schema: bytes
    first: int
    last: int
    prototype: bool

    @property
    def tag(self) -> bytes:
        return tag_of(self.origin, self.schema)


@dataclass(frozen=True, slots=True)
class Data:
    """Events with consecutive numbers, at least one."""

    tag: bytes
    events: tuple[Event, ...]


@dataclass(frozen=True, slots=True)
class Ack:
    """The sender of this frame has stored every event up to number `through`. After it follow `runs`: pairs of a number of
    missing and a number of stored events.
    """

    tag: bytes
    through: int
    runs: tuple[tuple[int, int], ...] = ()


@dataclass(frozen=True, slots=True)
class Lost:
    tag: bytes
    first: int
    last: int


@dataclass(frozen=True, slots=True)
class Ask:
    tag: bytes


@dataclass(frozen=True, slots=True)
class Refused:
    tag: bytes
    schema: bytes


Frame = Hello | Data | Ack | Lost | Ask | Refused


def tag_of(origin: str, schema: bytes) -> bytes:
    return hashlib.sha256(origin.encode() + b"\0" + schema).digest()[:TAG_BYTES]


# -- numbers --------------------------------------------------------------------------------------------------------------


def varint(number: int) -> bytes:
    """Encode an unsigned number, seven bits per byte, lowest first."""
    out = bytearray()
    while number > 0x7F:
        out.append(number & 0x7F | 0x80)
        number >>= 7
    out.append(number)
    return bytes(out)


def zigzag(number: int) -> bytes:
    """Encode a signed number as an unsigned one, so that small positive and small negative numbers need few bytes."""
    return varint(number << 1 if number >= 0 else (-number << 1) - 1)


class Reader:
    """Decodes a frame. Every read past the end raises `Desync`."""

    def __init__(self, data: bytes) -> None:
        self.data = data
        self.at = 0

    def take(self, count: int) -> bytes:
        end = self.at + count
        if end > len(self.data):
            raise Desync("a frame of a thread is too short", expected=f"{end} bytes", got=str(len(self.data)))
        part, self.at = self.data[self.at : end], end
        return part

    def varint(self) -> int:
        number = shift = 0
        while True:
            byte = self.take(1)[0]
            number |= (byte & 0x7F) << shift
            if byte < 0x80:
                return number
            shift += 7
            if shift > 63:
                raise Desync("a number in a frame of a thread", expected="at most 64 bits")

    def zigzag(self) -> int:
        number = self.varint()
        return -((number + 1) >> 1) if number & 1 else number >> 1

    def text(self, most: int) -> str:
        length = self.varint()
        if length > most:
            raise Desync("a text in a frame of a thread", expected=f"at most {most} bytes", got=str(length))
        try:
            return self.take(length).decode()
        except UnicodeDecodeError as e:
            raise Desync("a text in a frame of a thread", expected="UTF-8") from e

    @property
    def done(self) -> bool:
        return self.at == len(self.data)


# -- events ---------------------------------------------------------------------------------------------------------------


def _encode_value(value: Value) -> tuple[int, bytes]:
    if value is None:
        return _NONE, b""
    if isinstance(value, int):
        return _INT, zigzag(value)
    if isinstance(value, float):
        try:
            short = _F32.pack(value)
        except OverflowError:
            return _FLOAT64, _F64.pack(value)
        return (_FLOAT32, short) if _F32.unpack(short)[0] == value else (_FLOAT64, _F64.pack(value))
    data = value.encode() if isinstance(value, str) else value
    return _TEXT if isinstance(value, str) else _BYTES, varint(len(data)) + data


def _decode_value(kind: int, reader: Reader) -> Value:
    if kind == _NONE:
        return None
    if kind == _INT:
        return reader.zigzag()
    if kind == _FLOAT32:
        return float(_F32.unpack(reader.take(4))[0])
    if kind == _FLOAT64:
        return float(_F64.unpack(reader.take(8))[0])
    if kind == _TEXT:
        return reader.text(MAX_VALUE_BYTES)
    if kind == _BYTES and (length := reader.varint()) <= MAX_VALUE_BYTES:
        return reader.take(length)
    raise Desync("a value in a frame of a thread", expected="a kind from 0 to 5, and 4096 bytes at most", got=str(kind))


def _encode_event(event: Event, before_ms: int, numbers: dict[str, int]) -> bytes:
    kind, value = _encode_value(event.value)
    number = numbers.get(event.name)
    judged = bool(event.quality or event.reason)
    head = event.kind << 5 | kind << 2 | judged << 1 | (number is None)
    if number is None:
        name = event.name.encode()
        named = varint(len(name)) + name
    else:
        named = varint(number)
    quality = bytes([event.quality << 5 | event.reason]) if judged else b""
    return bytes([head]) + named + zigzag(event.t_ms - before_ms) + quality + value


def _decode_event(reader: Reader, sequence: int, before_ms: int, schema: Schema) -> Event:
    head = reader.take(1)[0]
    if head & 1:
        name = reader.text(MAX_VALUE_BYTES)
    else:
        number = reader.varint()
        if number >= len(schema.names):
            raise Desync("a name in a frame of a thread", expected=f"0 to {len(schema.names) - 1}", got=str(number))
        name = schema.names[number]
    t_ms = before_ms + reader.zigzag()
    judged = reader.take(1)[0] if head & 2 else 0
    value = _decode_value(head >> 2 & 7, reader)
    return Event(sequence, t_ms, head >> 5, name, value, judged >> 5, judged & 31)


# -- frames ---------------------------------------------------------------------------------------------------------------


class FrameCodec:
    """Converts frames to datagrams of at most `mtu` bytes, and back.

    Each link needs its own codec, because a codec remembers tags and pieces.
    """

    def __init__(self, schemas: Iterable[Schema], mtu: int) -> None:
        if mtu < SMALLEST_MTU:
            raise Bug("a carrier for a thread", expected=f"at least {SMALLEST_MTU} bytes a frame", got=str(mtu))
        self.mtu = mtu
        self._schemas = {schema.id: schema for schema in schemas}
        self._numbers = {s.id: {name: i for i, name in enumerate(s.names)} for s in self._schemas.values()}
        self._of_tag: OrderedDict[bytes, bytes] = OrderedDict()
        self._pieces: OrderedDict[tuple[bytes, int, int], dict[int, bytes]] = OrderedDict()

    def knows(self, schema: bytes) -> bool:
        """Return whether events of this schema can be decoded."""
        return schema in self._schemas

    def learn(self, tag: bytes, schema: bytes) -> None:
        """Remember the schema of a tag that was sent or received."""
        self._of_tag[tag] = schema
        self._of_tag.move_to_end(tag)
        if len(self._of_tag) > 64:
            self._of_tag.popitem(last=False)

    def fit(self, tag: bytes, events: Sequence[Event]) -> int:
        """Return how many of `events` go into one datagram; at least one, which may need pieces."""
        numbers, size, before = self._names(tag), 1 + TAG_BYTES, events[0].t_ms
        size += len(varint(events[0].sequence)) + len(zigzag(before))
        for count, event in enumerate(events[:MAX_EVENTS]):
            size += len(_encode_event(event, before, numbers))
            before = event.t_ms
            if size > self.mtu:
                return max(count, 1)
        return min(len(events), MAX_EVENTS)

    def _names(self, tag: bytes) -> dict[str, int]:
        return self._numbers.get(self._of_tag.get(tag, b""), {})

    def encode(self, frame: Frame) -> list[bytes]:
        """Return the datagrams of a frame: one, or the pieces of a large DATA frame."""
        if isinstance(frame, Data):
            data = self._encode_data(frame)
            return [data] if len(data) <= self.mtu else self._cut(frame, data)
        if isinstance(frame, Hello):
            self.learn(frame.tag, frame.schema)
            origin = frame.origin.encode()
            body = frame.schema + bytes([frame.prototype]) + varint(frame.first) + varint(frame.last) + origin
            return [self._fitting(bytes([VERSION << 4 | HELLO]) + frame.tag + body)]
        if isinstance(frame, Ack):
            head = bytes([VERSION << 4 | ACK]) + frame.tag + varint(frame.through)
            for gap, run in frame.runs:
                more = varint(gap) + varint(run)
                if len(head) + len(more) > self.mtu:
                    break  # the rest is reported in a later ACK
                head += more
            return [head]
        if isinstance(frame, Lost):
            return [bytes([VERSION << 4 | LOST]) + frame.tag + varint(frame.first) + varint(frame.last)]
        if isinstance(frame, Ask):
            return [bytes([VERSION << 4 | ASK]) + frame.tag]
        return [bytes([VERSION << 4 | REFUSED]) + frame.tag + frame.schema]

    def _fitting(self, data: bytes) -> bytes:
        if len(data) > self.mtu:
            raise Bug("a frame is larger than the carrier allows", expected=f"{self.mtu} bytes", got=str(len(data)))
        return data

    def _encode_data(self, frame: Data) -> bytes:
        numbers, before = self._names(frame.tag), frame.events[0].t_ms
        out = bytearray([VERSION << 4 | DATA]) + frame.tag + varint(frame.events[0].sequence) + zigzag(before)
        for event in frame.events:
            out += _encode_event(event, before, numbers)
            before = event.t_ms
        return bytes(out)

    def _cut(self, frame: Data, data: bytes) -> list[bytes]:
        head = bytes([VERSION << 4 | PIECE]) + frame.tag + varint(frame.events[0].sequence)
        room = self.mtu - len(head) - 4  # two numbers of at most two bytes
        parts = [data[at : at + room] for at in range(0, len(data), room)]
        if len(parts) > MAX_PIECES:
            raise Bug("a frame in too many pieces", expected=f"at most {MAX_PIECES}", got=str(len(parts)))
        return [head + varint(len(parts)) + varint(i) + part for i, part in enumerate(parts)]

    def decode(self, data: bytes) -> Frame | None:
        """Return a frame, or None for a piece of an incomplete frame. Raises `Desync` for invalid data."""
        reader = Reader(data)
        head = reader.take(1)[0]
        if head >> 4 != VERSION:
            raise Desync(
                "a frame of a different version of the thread protocol", expected=str(VERSION), got=str(head >> 4)
            )
        tag = reader.take(TAG_BYTES)
        kind = head & 15
        if kind == DATA:
            return self._decode_data(tag, reader)
        if kind == PIECE:
            return self._join(tag, reader)
        frame = self._decode_small(kind, tag, reader)
        if not reader.done:
            raise Desync("a frame of a thread is too long", got=f"{len(data) - reader.at} bytes more")
        return frame

    def _decode_small(self, kind: int, tag: bytes, reader: Reader) -> Frame:
        if kind == HELLO:
            schema, prototype = reader.take(SCHEMA_BYTES), reader.take(1)[0]
            first, last = reader.varint(), reader.varint()
            rest = reader.take(len(reader.data) - reader.at)
            try:
                hello = Hello(rest.decode(), schema, first, last, bool(prototype))
            except UnicodeDecodeError as e:
                raise Desync("the origin in a HELLO", expected="UTF-8") from e
            if hello.tag != tag or not rest or len(rest) > MAX_ORIGIN or not 1 <= first <= last + 1:
                raise Desync("a HELLO that contradicts itself", got=reader.data.hex())
            self.learn(tag, schema)
            return hello
        if kind == ACK:
            through = reader.varint()
            runs: list[tuple[int, int]] = []
            while not reader.done and len(runs) < MAX_RUNS:
                runs.append((reader.varint(), reader.varint()))
            return Ack(tag, through, tuple(runs))
        if kind == LOST:
            return Lost(tag, reader.varint(), reader.varint())
        if kind == ASK:
            return Ask(tag)
        if kind == REFUSED:
            return Refused(tag, reader.take(SCHEMA_BYTES))
        raise Desync("a frame of a thread", expected="a kind from 1 to 7", got=str(kind))

    def _decode_data(self, tag: bytes, reader: Reader) -> Data:
        schema = self._schemas.get(self._of_tag.get(tag, b""))
        if schema is None:
            return Data(tag, ())  # the receiver will ask what the tag means
        sequence, before = reader.varint(), reader.zigzag()
        events: list[Event] = []
        while not reader.done:
            if len(events) == MAX_EVENTS:
                raise Desync("too many events in a frame", expected=str(MAX_EVENTS))
            events.append(_decode_event(reader, sequence + len(events), before, schema))
            before = events[-1].t_ms
        if not events or not sequence:
            raise Desync("a DATA frame without events or number")
        return Data(tag, tuple(events))

    def _join(self, tag: bytes, reader: Reader) -> Frame | None:
        sequence, count, index = reader.varint(), reader.varint(), reader.varint()
        if not index < count <= MAX_PIECES:
            raise Desync("a piece of a frame", expected=f"one of at most {MAX_PIECES}", got=f"{index} of {count}")
        key = tag, sequence, count
        pieces = self._pieces.setdefault(key, {})
        self._pieces.move_to_end(key)
        pieces[index] = reader.take(len(reader.data) - reader.at)
        if len(self._pieces) > PARTIAL:
            self._pieces.popitem(last=False)
        if len(pieces) < count:
            return None
        self._pieces.pop(key, None)
        whole = b"".join(pieces[i] for i in range(count))
        if whole[:1] != bytes([VERSION << 4 | DATA]):
            raise Desync("pieces of a frame that is not DATA")
        return self.decode(whole)
