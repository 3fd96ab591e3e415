"""The server's side of the MBAP header (TG 3.1.3): parses Modbus TCP requests and encodes replies.

Each client has one object. An ADU of another protocol is dropped, and the stream continues. After an invalid length the
boundaries of ADUs are unknown, so `desync` is set, and the caller closes the connection. This module does no I/O; the caller
answers the requests.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

from fieldtwin.gateway.protocols.modbus.requests.request import MAX_PDU

_HEADER = struct.Struct(">HHHB")
_BEFORE_LENGTH_COUNTS = 6
_MIN_LENGTH = 2  # a unit id and a function code
_MAX_LENGTH = MAX_PDU + 1


@dataclass(frozen=True, slots=True)
class TcpRequest:
    """One request ADU; a reply carries the same transaction ID and unit ID."""

    transaction: int
    unit: int
    pdu: bytes

    def reply(self, pdu: bytes) -> bytes:
        """Return the ADU that answers with `pdu`."""
        return _HEADER.pack(self.transaction, 0, len(pdu) + 1, self.unit) + pdu


class MbapRequests:
    """The parser of the requests in a client's stream. Between calls it keeps less than one ADU."""

    def __init__(self) -> None:
        self._buffer = bytearray()
        self.foreign = 0
        """ADUs dropped because their protocol id is not Modbus's (case MB-054)."""
        self.desync = ""
        """The reason why the stream can no longer be read; empty while it is valid."""

    @property
    def unfinished(self) -> bool:
        """Return whether a request has begun and is not complete."""
        return bool(self._buffer)

    def feed(self, data: bytes) -> list[TcpRequest]:
        """Take the bytes that arrived; return the requests that are now complete, in order."""
        if self.desync:
            return []
        buffer = self._buffer
        buffer += data
        found: list[TcpRequest] = []
        at = 0
        while len(buffer) - at >= _BEFORE_LENGTH_COUNTS:
            length = buffer[at + 4] << 8 | buffer[at + 5]
            if not _MIN_LENGTH <= length <= _MAX_LENGTH:
                self.desync = f"an ADU of length {length}"
                at = len(buffer)
                break
            end = at + _BEFORE_LENGTH_COUNTS + length
            if len(buffer) < end:
                break
            transaction, protocol, _, unit = _HEADER.unpack_from(buffer, at)
            if protocol == 0:
                found.append(TcpRequest(transaction, unit, bytes(buffer[at + _HEADER.size : end])))
            else:
                self.foreign += 1
            at = end
        del buffer[:at]
        return found
