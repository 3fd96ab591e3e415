"""The correct Modbus device, from which the hostile server derives its replies. Every address exists, and every function of
the standard works.

All registers and bits hold one word, so that every value that a client reads and publishes is known; it reads back the
values that it wrote.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from fieldtwin.emulators.modbus.ascii import AsciiReceiver, lrc
from fieldtwin.emulators.modbus.bank import BIT_TABLES, RegisterBank, Table
from fieldtwin.emulators.modbus.rtu.receiver import RtuReceiver, with_crc
from fieldtwin.emulators.modbus.unit import ModbusUnit

READS = frozenset({0x01, 0x02, 0x03, 0x04})
REGISTER_READS = frozenset({0x03, 0x04})
WRITES = frozenset({0x05, 0x06, 0x0F, 0x10, 0x16})
MAX_LENGTH = 254


class OneWord(RegisterBank):
    """Registers that all hold `word`, and bits that hold its parity; `held` are fixed cells, and written values are kept."""

    def __init__(self, word: int, held: Mapping[tuple[Table, int], int] | None = None) -> None:
        self.word = word
        self.written: dict[tuple[Table, int], int] = dict(held or {})

    def read(self, table: Table, address: int, count: int, now_ns: int) -> Sequence[int]:
        usual = self.word & 1 if table in BIT_TABLES else self.word
        return [self.written.get((table, address + i), usual) for i in range(count)]

    def write(self, table: Table, address: int, values: Sequence[int], now_ns: int) -> None:
        self.written.update({(table, address + i): value for i, value in enumerate(values)})


class HonestDevice:
    """A device that answers every unit ID. Reads return `word`."""

    def __init__(self, word: int, held: Mapping[tuple[Table, int], int] | None = None) -> None:
        self._bank = OneWord(word, held)
        self._unit = ModbusUnit(self._bank, server_id=b"fieldtwin")

    @property
    def word(self) -> int:
        return self._bank.word

    @word.setter
    def word(self, value: int) -> None:
        self._bank.word = value

    def answer(self, pdu: bytes, now_ns: int) -> bytes:
        """Return the response PDU, empty for silence."""
        return self._unit.respond(pdu, now_ns) or b""

    def answer_with(self, word: int, pdu: bytes, now_ns: int) -> bytes:
        """Return the answer to a read that the device would give if all cells held `word`."""
        kept, written = self._bank.word, self._bank.written
        self._bank.word, self._bank.written = word, {}
        try:
            return self.answer(pdu, now_ns)
        finally:
            self._bank.word, self._bank.written = kept, written


class RtuWire:
    """A splitter of the requests on an RTU line, and a builder of frames for it."""

    framing = "rtu"

    def __init__(self) -> None:
        self._receiver = RtuReceiver(frozenset(range(1, 248)))
        self._noise = 0

    def cut(self, data: bytes, now_ns: int) -> list[tuple[bytes, int]]:
        """Return the complete requests. Each is a pair: unit ID and PDU as bytes, and 0 in place of a transaction ID."""
        return [(frame[:-2], 0) for frame in self._receiver.feed(data, now_ns)]

    def garbage(self) -> int:
        """Return the number of bytes since the last call that belong to no request."""
        new, self._noise = self._receiver.noise_bytes - self._noise, self._receiver.noise_bytes
        return new

    def frame(self, request: bytes, tag: int, pdu: bytes) -> bytes:
        return with_crc(request[:1] + pdu)


class AsciiWire:
    """A splitter of the requests on an ASCII line, and a builder of frames for it."""

    framing = "ascii"

    def __init__(self) -> None:
        self._receiver = AsciiReceiver()
        self._noise = 0

    def cut(self, data: bytes, now_ns: int) -> list[tuple[bytes, int]]:
        """Return the complete requests. Each is a pair: unit ID and PDU as bytes, and 0 in place of a transaction ID."""
        return [(frame[:-1], 0) for frame in self._receiver.feed(data, now_ns)]

    def garbage(self) -> int:
        """Return the number of characters since the last call that belong to no request."""
        new, self._noise = self._receiver.noise_bytes - self._noise, self._receiver.noise_bytes
        return new

    def frame(self, request: bytes, tag: int, pdu: bytes) -> bytes:
        return in_ascii(request[:1] + pdu)


def in_ascii(adu: bytes) -> bytes:
    """Return a frame of Modbus ASCII around unit ID and PDU (SL 2.5.2)."""
    return b":" + (adu + bytes((lrc(adu),))).hex().upper().encode("ascii") + b"\r\n"


class MbapWire:
    """A splitter of the requests on Modbus TCP, and a builder of ADUs for it."""

    framing = "tcp"

    def __init__(self) -> None:
        self._buffer = bytearray()
        self._garbage = 0

    def cut(self, data: bytes, now_ns: int) -> list[tuple[bytes, int]]:
        """Return the complete requests. Each is a pair: unit ID and PDU as bytes, and the transaction ID."""
        self._buffer += data
        found = []
        while len(self._buffer) >= 6:
            length = int.from_bytes(self._buffer[4:6], "big")
            if not 2 <= length <= MAX_LENGTH or self._buffer[2:4] != b"\0\0":
                self._garbage += len(self._buffer)
                self._buffer.clear()
                break
            if len(self._buffer) < 6 + length:
                break
            found.append((bytes(self._buffer[6 : 6 + length]), int.from_bytes(self._buffer[:2], "big")))
            del self._buffer[: 6 + length]
        return found

    def garbage(self) -> int:
        """Return the number of bytes since the last call that belong to no request."""
        new, self._garbage = self._garbage, 0
        return new

    def frame(self, request: bytes, tag: int, pdu: bytes) -> bytes:
        return mbap(tag, request[0], pdu)


def mbap(tag: int, unit: int, pdu: bytes, *, protocol: int = 0, length: int | None = None) -> bytes:
    """Return an ADU of Modbus TCP; `protocol` and `length` override the header's fields to make it invalid (TG 3.1.3)."""
    counted = len(pdu) + 1 if length is None else length
    return b"".join(n.to_bytes(2, "big") for n in (tag, protocol, counted)) + bytes((unit,)) + pdu


ModbusWire = RtuWire | AsciiWire | MbapWire
