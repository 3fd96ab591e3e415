"""File records, functions 14h and 15h (AP 6.14, 6.15): numbered files of 16-bit records.

Pure: request PDU in, response PDU out. What a file means is the device's business.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from fieldtwin.emulators.modbus.bank import IllegalAddress, IllegalValue
from fieldtwin.gateway.core.errors import UsageError

REFERENCE_TYPE = 6
MAX_RECORDS = 10_000
"""Records of a file: 0000h to 270Fh."""
_GROUP = 7
"""Bytes of a sub-request: reference type, file, record, count."""
_MOST_READ, _MOST_ASKED, _MOST_WRITTEN = 0xF5, 0xF5, 0xFB


@dataclass(frozen=True, slots=True)
class Group:
    """One sub-request; `values` of a write."""

    file: int
    record: int
    count: int
    values: tuple[int, ...] = ()


class FileRecords:
    """The files of a unit: number (1 to 65535) -> records it has (1 to 10000), all zero at first.

    `read_only` files refuse writes with exception 02.
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
        """What the file holds, as the device sees it. Raises `IllegalAddress`."""
        return self._span(Group(file, record, count))[record : record + count]

    def poke(self, file: int, record: int, *values: int) -> None:
        """The device sets its own records, read-only files included. Raises `IllegalAddress`."""
        self._span(Group(file, record, len(values)))[record : record + len(values)] = values

    def respond_read(self, pdu: bytes, now_ns: int) -> bytes:
        """Function 14h. All spans, or a `Refusal`."""
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
        """Function 15h: all spans are written, or none and a `Refusal`. The response is the request."""
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
            groups.append(Group(group.file, group.record, group.count, values))
        for group in groups:
            self._span(group)
            if group.file in self._read_only:
                raise IllegalAddress(f"file {group.file} is read-only")
        for group in groups:
            self.poke(group.file, group.record, *group.values)
        return pdu

    def _span(self, group: Group) -> list[int]:
        records = self._files.get(group.file)
        if records is None or not 1 <= group.count <= len(records) - group.record:
            raise IllegalAddress(f"{group.count} records from {group.record} of file {group.file}")
        return records


def _group(data: bytes) -> Group:
    if data[0] != REFERENCE_TYPE:  # 02 for all that a sub-request says, by the flow chart of AP 6.14
        raise IllegalAddress("reference type", expected=str(REFERENCE_TYPE), got=str(data[0]))
    file, record, count = (data[i] << 8 | data[i + 1] for i in (1, 3, 5))
    return Group(file, record, count)
