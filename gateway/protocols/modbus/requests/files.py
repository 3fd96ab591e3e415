"""File records and FIFO queues: 14h, 15h and 18h (AP 6.14, 6.15, 6.18).

This module encodes the requests itself, because pymodbus's classes for them check nothing, and its replies to 18h do not work
with the framings of this project. A file has a number and up to 10,000 records of one word; the device defines their meaning.
"""

from __future__ import annotations

from dataclasses import dataclass

from fieldtwin.gateway.core.errors import Desync, UsageError, VerifyFailed
from fieldtwin.gateway.protocols.modbus.requests.data import check_range
from fieldtwin.gateway.protocols.modbus.requests.pdus import words_of, words_to_bytes
from fieldtwin.gateway.protocols.modbus.requests.replies import FileRecordsReply, RegistersReply, WriteReply
from fieldtwin.gateway.protocols.modbus.requests.request import IMPOSSIBLE, MAX_PDU, NEED_MORE, Request, short_hex

_REFERENCE_TYPE = 6
_LAST_RECORD = 9999
_MOST_READ_BYTES = 0xF5
_MOST_WRITE_BYTES = 0xFB
_MOST_QUEUED = 31


@dataclass(frozen=True, slots=True)
class FileSpan:
    """`count` records of a file, beginning with `record` (0 to 9999). File numbers are 1 to 65535."""

    file: int
    record: int
    count: int

    def __post_init__(self) -> None:
        check_range("file number", self.file, 1, 0xFFFF)
        check_range("record number", self.record, 0, _LAST_RECORD)
        check_range("records", self.count, 1, (MAX_PDU - 4) // 2)
        check_range("last record", self.record + self.count - 1, 0, _LAST_RECORD)

    def encode(self) -> bytes:
        """Return the group of a sub-request: reference type, file, record, count."""
        words = (self.file, self.record, self.count)
        return bytes([_REFERENCE_TYPE]) + b"".join(word.to_bytes(2, "big") for word in words)


@dataclass(frozen=True, slots=True)
class ReadFileRecords(Request[FileRecordsReply]):
    """Function 14h: several spans of files in one transaction; the reply must fit a PDU as well."""

    spans: tuple[FileSpan, ...]

    def __post_init__(self) -> None:
        check_range("file spans", len(self.spans), 1, _MOST_READ_BYTES // 7)
        check_range("bytes of the reply", self._reply_data(), 1, _MOST_READ_BYTES)

    def _reply_data(self) -> int:
        return sum(2 + 2 * span.count for span in self.spans)

    @property
    def function(self) -> int:
        return 0x14

    def encode(self) -> bytes:
        groups = b"".join(span.encode() for span in self.spans)
        return bytes([0x14, len(groups)]) + groups

    def nominal_length(self) -> int:
        return 2 + self._reply_data()

    def reply_length(self, head: bytes) -> int:
        if len(head) < 2:
            return NEED_MORE
        return self.nominal_length() if head[1] == self._reply_data() else IMPOSSIBLE

    def decode(self, pdu: bytes, t_ns: int) -> FileRecordsReply:
        records, at = [], 2
        for span in self.spans:
            end = at + 2 + 2 * span.count
            if (pdu[at], pdu[at + 1]) != (1 + 2 * span.count, _REFERENCE_TYPE):
                raise Desync("a group of file records of the wrong size", got=short_hex(pdu[at:]))
            records.append(words_of(pdu[at + 2 : end]))
            at = end
        return FileRecordsReply(tuple(records), bytes(pdu[2:]), t_ns)


@dataclass(frozen=True, slots=True)
class WriteFileRecords(Request[WriteReply]):
    """Function 15h: groups of (file, first record, values). The reply repeats all groups, and all of them are verified."""

    groups: tuple[tuple[int, int, tuple[int, ...]], ...]

    def __post_init__(self) -> None:
        if not self.groups:
            raise UsageError("no file records to write", expected="at least one group")
        for file, record, values in self.groups:
            FileSpan(file, record, len(values))  # its constructor checks the range
            for value in values:
                check_range("record value", value, 0, 0xFFFF)
        check_range("bytes of the request", len(self.encode()) - 2, 1, _MOST_WRITE_BYTES)

    @property
    def function(self) -> int:
        return 0x15

    def encode(self) -> bytes:
        data = b"".join(FileSpan(f, r, len(values)).encode() + words_to_bytes(values) for f, r, values in self.groups)
        return bytes([0x15, min(len(data), 0xFF)]) + data

    def nominal_length(self) -> int:
        return len(self.encode())

    def reply_length(self, head: bytes) -> int:
        sent = self.encode()
        if len(head) < 2:
            return NEED_MORE
        return len(sent) if head[1] == sent[1] else IMPOSSIBLE

    def decode(self, pdu: bytes, t_ns: int) -> WriteReply:
        expected = self.encode()
        if pdu != expected:
            raise VerifyFailed(
                "the acknowledgement of function 15h differs from the request",
                expected=short_hex(expected),
                got=short_hex(pdu),
            )
        return WriteReply(bytes(pdu[1:]), t_ns)

    def unanswered(self, t_ns: int) -> WriteReply:
        return WriteReply(b"", t_ns, acknowledged=False)


@dataclass(frozen=True, slots=True)
class ReadFifoQueue(Request[RegistersReply]):
    """Function 18h: the words (at most 31) of the queue whose count register is at `address`. The queue is not changed.

    It is the only function whose byte count has two bytes (case MB-044).
    """

    address: int

    def __post_init__(self) -> None:
        check_range("address", self.address, 0, 0xFFFF)

    @property
    def function(self) -> int:
        return 0x18

    def encode(self) -> bytes:
        return b"\x18" + self.address.to_bytes(2, "big")

    def reply_length(self, head: bytes) -> int:
        if len(head) < 3:
            return IMPOSSIBLE if len(head) == 2 and head[1] else NEED_MORE
        byte_count = int.from_bytes(head[1:3], "big")
        if byte_count % 2 or not 2 <= byte_count <= 2 + 2 * _MOST_QUEUED:
            return IMPOSSIBLE
        return 3 + byte_count

    def decode(self, pdu: bytes, t_ns: int) -> RegistersReply:
        if int.from_bytes(pdu[3:5], "big") * 2 != len(pdu) - 5:
            raise Desync("the count of a FIFO queue does not fit its byte count", got=short_hex(pdu))
        return RegistersReply(bytes(pdu[5:]), t_ns)
