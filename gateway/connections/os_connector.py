"""The `Connector` for the real plant: it opens the serial port, socket or CAN bus that an endpoint names.

This module must not know that a simulation exists. A wrapper around this connector may replace the endpoint of a device by that
of its emulator.
"""

from __future__ import annotations

import sys
from pathlib import Path

from fieldtwin.gateway.core.connection import ByteConnection, CanConnection, Connector
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.core.files.port_marker import refuse_dead_port

BYTE_SCHEMES = "rtu:, ascii:, tcp:, rtu+tcp:, udp: or tls:"


class OsConnector(Connector):
    """A connector for the serial ports, TCP and TLS streams, UDP sockets and CAN buses of this computer.

    The code for each kind of link is imported when the first one is opened: a plant without CAN does not load
    python-can.
    """

    async def open_bytes(self, endpoint: Endpoint) -> ByteConnection:
        """Open an endpoint whose scheme is one of `BYTE_SCHEMES`. Raises the errors of `Connector`.

        A link to a virtual serial port is not followed if the program that made it was killed: the link may then lead to another
        program's terminal.
        """
        match endpoint.scheme:
            case "rtu" | "ascii":
                if sys.platform == "win32":  # COM ports have no descriptors
                    from fieldtwin.gateway.connections.serial.threads import ThreadedSerialConnection

                    return await ThreadedSerialConnection.open(endpoint)
                from fieldtwin.gateway.connections.serial.line import SerialConnection

                refuse_dead_port(Path(endpoint.path), str(endpoint))
                return await SerialConnection.open(endpoint)
            case "tcp" | "rtu+tcp":
                from fieldtwin.gateway.connections.sockets.tcp import TcpConnection

                return await TcpConnection.open(endpoint)
            case "tls":
                from fieldtwin.gateway.connections.sockets.tls import TlsConnection

                return await TlsConnection.open(endpoint)
            case "udp":
                from fieldtwin.gateway.connections.sockets.udp import UdpConnection

                return await UdpConnection.open(endpoint)
            case "can":
                raise UsageError("a CAN bus carries frames, not bytes", expected=BYTE_SCHEMES)
            case "pty":
                raise UsageError(
                    f"{endpoint} is the listening side of a virtual serial port",
                    expected=f"rtu:{endpoint.path} on the side that opens it",
                )
            case scheme:
                raise UsageError(f"{endpoint}: {scheme}: cannot be opened by this program", expected=BYTE_SCHEMES)

    async def open_can(self, endpoint: Endpoint, bitrate: int) -> CanConnection:
        """Open ``can:socketcan/CHANNEL``, ``can:fieldtwin/HOST:PORT``, or any other interface of python-can.

        Raises the errors of `Connector`.
        """
        if not endpoint.is_can:
            raise UsageError(f"{endpoint} is not a CAN bus", expected="can:INTERFACE/CHANNEL")
        match endpoint.interface:
            case "socketcan":
                from fieldtwin.gateway.connections.can.socketcan import SocketCanConnection

                return await SocketCanConnection.open(endpoint, bitrate)
            case "fieldtwin":
                from fieldtwin.gateway.connections.can.soft_bus import SoftBusConnection

                return await SoftBusConnection.open(endpoint, bitrate)
            case _:
                from fieldtwin.gateway.connections.can.adapter import AdapterConnection

                return await AdapterConnection.open(endpoint, bitrate)
