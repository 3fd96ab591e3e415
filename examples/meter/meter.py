"""A user's driver: an energy meter over Modbus TCP, with plain sockets. It does not know fieldtwin."""

from __future__ import annotations

import socket
import struct
from types import TracebackType


class MeterError(Exception):
    """The meter did not answer, or refused."""


class Meter:
    """``with Meter("10.0.0.7", 502, unit=1) as meter: meter.voltage()``."""

    def __init__(self, host: str, port: int, unit: int, timeout_s: float = 0.2, attempts: int = 2) -> None:
        self._unit, self._attempts = unit, attempts
        self._socket = socket.create_connection((host, port), timeout_s)
        self._transaction = 0

    def __enter__(self) -> Meter:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._socket.close()

    def voltage(self) -> float:
        """Volts between L1 and neutral."""
        (value,) = struct.unpack(">f", self._request(struct.pack(">BHH", 4, 0, 2))[2:])
        return float(value)

    def set_demand_period(self, minutes: int) -> None:
        self._request(struct.pack(">BHHB4s", 16, 2, 2, 4, struct.pack(">f", minutes)))

    def _request(self, pdu: bytes) -> bytes:
        for _ in range(self._attempts):
            self._transaction += 1
            self._socket.sendall(struct.pack(">HHHB", self._transaction, 0, len(pdu) + 1, self._unit) + pdu)
            try:
                reply = self._reply(self._transaction)
            except TimeoutError:
                continue
            if reply[0] & 0x80:
                raise MeterError(f"exception {reply[1]}")
            return reply
        raise MeterError("no reply")

    def _reply(self, transaction: int) -> bytes:
        while True:
            head = self._receive(7)
            body = self._receive(int.from_bytes(head[4:6], "big") - 1)
            if int.from_bytes(head[:2], "big") == transaction:  # otherwise a late reply to an earlier request
                return body

    def _receive(self, size: int) -> bytes:
        data = b""
        while len(data) < size:
            data += self._socket.recv(size - len(data))
        return data
