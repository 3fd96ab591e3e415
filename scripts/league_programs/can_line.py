"""A CAN bus for third-party programs of the league: text lines such as ``605#4000200000000000`` on a TCP connection.

``FIELDTWIN_CAN_LINE`` holds ``HOST:PORT``. Eight digits in front of ``#`` are an extended identifier, and ``#R`` is a remote
frame. Both `can_relay.py` and the confirming programs serve such a connection.
"""

from __future__ import annotations

import os
import select
import socket
from typing import Any

import can


def to_line(message: can.Message) -> str:
    """Return the message as a line without its end."""
    digits = f"{message.arbitration_id:08X}" if message.is_extended_id else f"{message.arbitration_id:03X}"
    return f"{digits}#{'R' if message.is_remote_frame else bytes(message.data).hex().upper()}"


def from_line(line: str) -> can.Message:
    """Return the message of a line."""
    digits, _, data = line.strip().partition("#")
    remote = data.startswith("R")
    return can.Message(
        arbitration_id=int(digits, 16),
        is_extended_id=len(digits) == 8,
        is_remote_frame=remote,
        data=b"" if remote else bytes.fromhex(data),
    )


class LineBus(can.BusABC):
    """The bus that python-can's users open; `channel` is ignored because the environment names the connection."""

    def __init__(self, channel: Any = None, **options: Any) -> None:
        super().__init__(channel=channel)
        host, _, port = os.environ["FIELDTWIN_CAN_LINE"].rpartition(":")
        self._socket = socket.create_connection((host, int(port)))
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._pending = b""
        self.channel_info = os.environ["FIELDTWIN_CAN_LINE"]

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        self._socket.sendall(to_line(msg).encode() + b"\n")

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        while b"\n" not in self._pending:
            if not select.select([self._socket], [], [], timeout)[0]:
                return None, False
            chunk = self._socket.recv(4096)
            if not chunk:
                raise can.CanOperationError("the bus ended")
            self._pending += chunk
        line, _, self._pending = self._pending.partition(b"\n")
        return from_line(line.decode()), False

    def fileno(self) -> int:
        return -1  # lines may be pending while the socket is empty, so a reader thread is necessary

    def shutdown(self) -> None:
        super().shutdown()
        self._socket.close()
