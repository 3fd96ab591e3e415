"""Convert the output of modpoll and mbpoll into exchanges: the request that they report, and the values that they received.

Both programs print values and no bytes, so the reply is reconstructed from the values: 16-bit registers and bits as they are,
32-bit values in the word order that the output names, or in modpoll's order (low word first) if it names none. They print no
times; polls are spaced by their rate. A poll that failed with a named exception becomes an exchange with that exception; any
other failed poll has no reply. The module opens no files and holds one poll in memory.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.core.files.recording import RecordedExchange

_SLAVE = re.compile(r"Slave configuration\.*:\s*address = \[?(\d+)")
_START = re.compile(r"start reference = (\d+)")
_COUNT = re.compile(r"count = (\d+)")
_RATE = re.compile(r"poll rate (?:=\s*)?(\d+)")
_KIND = re.compile(r"Data type\.*:\s*(.+)")
_POLL = re.compile(r"-- Polling")
_VALUE = re.compile(r"\[(\d+)\]:\s*(\S.*)")
_FAILED = re.compile(r"(?:Read .* failed|.*!): ?(.*)|(.*(?:time-?out|Illegal|exception).*)", re.IGNORECASE)
_EXCEPTIONS = {
    "illegal function": 1,
    "illegal data address": 2,
    "illegal data value": 3,
    "slave device or server failure": 4,
}
_FUNCTIONS = (("discrete output", 1), ("coil", 1), ("discrete input", 2), ("input register", 4), ("holding", 3))
MAX_CELLS = 2000
IS_POLL_TEXT = re.compile(r"FieldTalk\(tm\) Modbus")


@dataclass(slots=True)
class _Asked:
    unit: int = 1
    start: int = 1
    count: int = 1
    rate_s: float = 1.0
    function: int = 3
    kind: str = ""

    @property
    def width(self) -> int:
        """Return the number of registers of a value."""
        return 2 if "32-bit" in self.kind else 1

    def exchange(self, number: int, cells: dict[int, str], failed: str) -> RecordedExchange:
        """Return the poll as an exchange with these values, or with this failure."""
        registers = self.count * self.width
        address = self.start - 1 if self.start else 0
        request = struct.pack(">BHH", self.function, address, registers)
        t_s = round(number * self.rate_s, 6)
        if failed or not cells:
            code = next((c for text, c in _EXCEPTIONS.items() if text in failed.lower()), 0)
            if not code:
                return RecordedExchange(t_s, self.unit, request, None, 0.0, "timeout")
            return RecordedExchange(t_s, self.unit, request, bytes((self.function | 0x80, code)))
        values = [cells[self.start + i * self.width] for i in range(self.count)]
        data = self._bits(values) if self.function <= 2 else b"".join(self._registers(v) for v in values)
        return RecordedExchange(t_s, self.unit, request, bytes((self.function, len(data))) + data)

    @staticmethod
    def _bits(values: list[str]) -> bytes:
        packed = sum(1 << i for i, v in enumerate(values) if _number(v))
        return packed.to_bytes((len(values) + 7) // 8, "little")

    def _registers(self, text: str) -> bytes:
        if self.width == 1:
            return struct.pack(">H", _number(text) & 0xFFFF)
        if "float" in self.kind:
            raw = struct.pack(">f", float(text.split()[0]))
        else:
            raw = struct.pack(">I", _number(text) & 0xFFFFFFFF)
        return raw if "big endian" in self.kind else raw[2:] + raw[:2]


def read_polls(lines: Iterable[str], path: str = "") -> Iterator[RecordedExchange]:
    """Yield the polls of one or several sessions in sequence. Raises `FileInvalid` with `path` and line."""
    asked, cells, failed, polls, number = _Asked(), dict[int, str](), "", 0, 0
    polling = False
    for number, line in enumerate(lines, 1):
        text = line.strip()
        try:
            if _POLL.match(text) or text.startswith("Protocol configuration"):
                if polling and (cells or failed):
                    yield asked.exchange(polls, cells, failed)
                    polls += 1
                cells, failed, polling = {}, "", bool(_POLL.match(text))
            elif polling and (found := _VALUE.match(text)):
                cells[int(found[1])] = found[2]
                if len(cells) > MAX_CELLS:
                    raise ValueError(f"more than {MAX_CELLS} values in a poll")
            elif polling and (failure := _FAILED.match(text)):
                failed = failure[1] or failure[2] or text
            elif not polling:
                _read_head(asked, text)
        except (ValueError, KeyError, struct.error, OverflowError) as e:
            raise _invalid(path, number, e) from e
    if polling and (cells or failed):
        try:
            yield asked.exchange(polls, cells, failed)
        except (ValueError, KeyError, struct.error, OverflowError) as e:
            if len(cells) == asked.count:
                raise _invalid(path, number, e) from e  # the file ends inside its last poll


def _read_head(asked: _Asked, text: str) -> None:
    if found := _SLAVE.search(text):
        asked.unit = int(found[1])
    if found := _START.search(text):
        asked.start = int(found[1])
    if found := _COUNT.search(text):
        asked.count = int(found[1])
    if found := _RATE.search(text):
        asked.rate_s = int(found[1]) / 1000
    if found := _KIND.search(text):
        asked.kind = found[1].lower()
        asked.function = next((f for words, f in _FUNCTIONS if words in asked.kind), 3)
    if not 0 <= asked.unit <= 255 or not 1 <= asked.count <= MAX_CELLS or asked.start > 0xFFFF + 1:
        raise ValueError(f"unit {asked.unit}, start {asked.start}, count {asked.count}")


def _number(text: str) -> int:
    """Return the integer in texts such as ``0x0003``, ``3``, ``-5``, ``65531 (-5)``."""
    first = text.split()[0]
    return int(first, 16) if first.lower().startswith("0x") else int(first)


def _invalid(path: str, line: int, error: Exception) -> FileInvalid:
    return FileInvalid(
        f"not what modpoll or mbpoll print: {error or type(error).__name__}", path=path, line=line,
        expected="[ADDRESS]: VALUE, as many as the header's count says",
    )  # fmt: skip
