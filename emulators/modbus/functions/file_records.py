"""File records, functions 14h and 15h (AP 6.14, 6.15): numbered files of 16-bit records.

This module performs no I/O: it takes a request PDU and returns a response PDU. The device defines the meaning of each file.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from fieldtwin.emulators.modbus.bank import IllegalValue, NoSuchAddress
from fieldtwin.gateway.core.errors import UsageError

REFERENCE_TYPE = 6
MAX_RECORDS = 10_000
"""The largest number of records in a file, which have the numbers 0000h to 270Fh."""
_GROUP = 7
"""The number of bytes of a sub-request: reference type (1), file, record and count (2 each)."""
_MOST_READ, _MOST_ASKED, _MOST_WRITTEN = 0xF5, 0xF5, 0xFB


@dataclass(frozen=True, slots=True)
class RecordGroup:
    """One sub-request; `values` holds the records of a write."""

    file: int
    record: int
    count: int
    values: tuple[int, ...] = ()


class FileRecords:
    """The files of a unit: file number (1 to 65535) -> number of records (1 to 10000), all zero at first.

    Writes to `read_only` files are refused with exception 02.
    """

    def __init__(self, sizes: Mapping[int, int], read_only: Sequence[int] = ()) -> None:
        for number, size in sizes.items():
            if not 1 <= number <= 0xFFFF or not 1 <= size <= MAX_RECORDS:
                raise UsageError(
                    "file", expected=f"number 1 to 65535, 1 to {MAX_RECORDS} records", got=f"{number}: {size}"
                )
        self._files = {number: [0] * size for number, size in sizes.items()}
        self._read_only = frozenset(read_only)

    def peek(self, file: int, record: int, count: int = 1) -> list[int]:
        """Return records of a file, for the device itself. Raises `NoSuchAddress`."""
        return self._span(RecordGroup(file, record, count))[record : record + count]

    def poke(self, file: int, record: int, *values: int) -> None:
        """Set records for the device itself, even in files that a client may only read. Raises `NoSuchAddress`."""
        self._span(RecordGroup(file, record, len(values)))[record : record + len(values)] = values

    def respond_read(self, pdu: bytes, now_ns: int) -> bytes:
        """Answer function 14h: return all requested spans, or raise a `Refusal`."""
        if len(pdu) < 2 or pdu[1] != len(pdu) - 2 or not _GROUP <= pdu[1] <= _MOST_ASKED or pdu[1] % _GROUP:
            raise IllegalValue("byte count of a file request", got=pdu[1:2].hex())
        groups = [_group(pdu[at : at + _GROUP]) for at in range(2, len(pdu), _GROUP)]
        size = sum(2 + 2 * group.count for group in groups)
        if size > _MOST_READ:
            raise IllegalValue("bytes of the reply", expected=f"at most {_MOST_READ}", got=str(size))
        data = bytearray()
        for group in groups:
            values = self.peek(group.file, group.record, group.count)
            data += bytes((1 + 2 * group.count, REFERENCE_TYPE)) + b"".join(v.to_bytes(2, "big") for v in values)
        return bytes((pdu[0], size)) + data

    def respond_write(self, pdu: bytes, now_ns: int) -> bytes:
        """Answer function 15h: write all spans, or write none and raise a `Refusal`. The response is the request."""
        if len(pdu) < 2 or pdu[1] != len(pdu) - 2 or not _GROUP + 2 <= pdu[1] <= _MOST_WRITTEN:
            raise IllegalValue("byte count of a file request", got=pdu[1:2].hex())
        groups, at = [], 2
        while at < len(pdu):
            if len(pdu) < at + _GROUP:
                raise IllegalValue("file request is cut off")
            group = _group(pdu[at : at + _GROUP])
            at += _GROUP
            data = pdu[at : at + 2 * group.count]
            if len(data) != 2 * group.count:
                raise IllegalValue(
                    "records and their count differ", expected=str(group.count), got=f"{len(data)} bytes"
                )
            at += len(data)
            values = tuple(data[i] << 8 | data[i + 1] for i in range(0, len(data), 2))
            groups.append(RecordGroup(group.file, group.record, group.count, values))
        for group in groups:
            self._span(group)
            if group.file in self._read_only:
                raise NoSuchAddress(f"file {group.file} is read-only")
        for group in groups:
            self.poke(group.file, group.record, *group.values)
        return pdu

    def _span(self, group: RecordGroup) -> list[int]:
        records = self._files.get(group.file)
        if records is None or not 1 <= group.count <= len(records) - group.record:
            raise NoSuchAddress(f"{group.count} records from {group.record} of file {group.file}")
        return records


def _group(data: bytes) -> RecordGroup:
    if data[0] != REFERENCE_TYPE:  # the flow chart of AP 6.14 gives 02 for every field of a sub-request
        raise NoSuchAddress("reference type", expected=str(REFERENCE_TYPE), got=str(data[0]))
    file, record, count = (data[i] << 8 | data[i + 1] for i in (1, 3, 5))
    return RecordGroup(file, record, count)
