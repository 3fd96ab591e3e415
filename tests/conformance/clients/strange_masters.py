"""Third-party clients, each a program for `fieldtwin check modbus-client|canopen-master -- python strange_masters.py
NAME`.

Each reads two registers (one object) 20 ms after the last answer, with a timeout of 150 ms and without retries. It
prints the values, so that `--probe output` sees them. It catches exceptions of the library, and reconnects if the
library supports that.
"""

from __future__ import annotations

import asyncio
import inspect
import os
import sys
from collections.abc import Callable
from typing import Any

TIMEOUT_S, PAUSE_S = 0.15, 0.02
Master = tuple[Callable[[], Any], Callable[[], object]]
"""Read the value (None if there is none) and reconnect; both functions may return an awaitable."""


def _tcp() -> tuple[str, int]:
    return os.environ["FIELDTWIN_HOST"], int(os.environ["FIELDTWIN_PORT"])


def _pymodbus(client: Any) -> Master:
    def read() -> int | None:
        reply = client.read_holding_registers(0, count=2, device_id=1)
        return None if reply.isError() else reply.registers[0]

    client.connect()
    return read, client.connect


def pymodbus_tcp() -> Master:
    from pymodbus.client import ModbusTcpClient

    host, port = _tcp()
    return _pymodbus(ModbusTcpClient(host, port=port, timeout=TIMEOUT_S, retries=0))


def pymodbus_rtu(framer: str = "rtu") -> Master:
    from pymodbus import FramerType
    from pymodbus.client import ModbusSerialClient

    tty, framing = os.environ["FIELDTWIN_TTY"], FramerType(framer)
    return _pymodbus(ModbusSerialClient(tty, framer=framing, baudrate=19200, parity="N", timeout=TIMEOUT_S, retries=0))


def _pymodbus_async(client: Any) -> Master:
    async def read() -> int | None:
        if not client.connected:
            await client.connect()
        reply = await client.read_holding_registers(0, count=2, device_id=1)
        return None if reply.isError() else reply.registers[0]

    return read, client.connect


def pymodbus_async_tcp() -> Master:
    from pymodbus.client import AsyncModbusTcpClient

    host, port = _tcp()
    return _pymodbus_async(AsyncModbusTcpClient(host, port=port, timeout=TIMEOUT_S, retries=0))


def pymodbus_async_rtu() -> Master:
    from pymodbus.client import AsyncModbusSerialClient

    tty = os.environ["FIELDTWIN_TTY"]
    return _pymodbus_async(AsyncModbusSerialClient(tty, baudrate=19200, parity="N", timeout=TIMEOUT_S, retries=0))


def pymodbus_ascii() -> Master:
    return pymodbus_rtu("ascii")


def minimalmodbus_rtu(mode: str = "rtu") -> Master:
    import minimalmodbus

    device = minimalmodbus.Instrument(os.environ["FIELDTWIN_TTY"], 1, mode=mode)
    device.serial.baudrate, device.serial.timeout = 19200, TIMEOUT_S
    return lambda: device.read_registers(0, 2)[0], lambda: None


def minimalmodbus_ascii() -> Master:
    return minimalmodbus_rtu("ascii")


def modbus_tk_tcp() -> Master:
    from modbus_tk.modbus_tcp import TcpMaster

    host, port = _tcp()
    return _modbus_tk(TcpMaster(host, port, timeout_in_sec=TIMEOUT_S))


def modbus_tk_rtu() -> Master:
    from modbus_tk.modbus_rtu import RtuMaster
    from serial import Serial

    master = RtuMaster(Serial(os.environ["FIELDTWIN_TTY"], baudrate=19200))
    master.set_timeout(TIMEOUT_S)
    return _modbus_tk(master)


def _modbus_tk(master: Any) -> Master:
    """`open` does nothing while the library considers itself connected, like pymodbus's `connect`."""
    return lambda: master.execute(1, 3, 0, 2)[0], master.open


def pymodbustcp() -> Master:
    from pyModbusTCP.client import ModbusClient

    host, port = _tcp()
    client = ModbusClient(host=host, port=port, unit_id=1, timeout=TIMEOUT_S, auto_open=True)
    return lambda: (client.read_holding_registers(0, 2) or [None])[0], lambda: None


def umodbus_tcp() -> Master:
    import socket

    from umodbus.client import tcp

    link = [socket.create_connection(_tcp(), timeout=TIMEOUT_S)]

    def again() -> None:
        link[0].close()
        link[0] = socket.create_connection(_tcp(), timeout=TIMEOUT_S)

    return lambda: tcp.send_message(tcp.read_holding_registers(1, 0, 2), link[0])[0], again


def canopen(block: str = "") -> Master:
    import canopen as library
    from canopen.objectdictionary import ODVariable

    from fieldtwin.gateway.connections.soft_bus import SoftBus

    network = library.Network()
    network.bus = SoftBus(channel=os.environ["FIELDTWIN_CHANNEL"])
    network.connect()
    objects = library.ObjectDictionary()
    for index in (0x2000, 0x2100):
        variable = ODVariable(f"x{index:X}", index, 0)
        variable.data_type = 0xF  # DOMAIN
        objects.add_object(variable)
    node = library.RemoteNode(5, objects)
    network.add_node(node)
    node.sdo.RESPONSE_TIMEOUT = TIMEOUT_S

    def read() -> int:
        if block == "up":
            with node.sdo[0x2000].open("rb", block_transfer=True) as file:
                return int.from_bytes(file.read()[:4], "little")
        value = int.from_bytes(node.sdo.upload(0x2000, 0), "little")
        if block == "down":
            with node.sdo[0x2100].open("wb", size=50, block_transfer=True) as file:
                file.write(bytes(range(50)))
        return value

    return read, lambda: None


def canopen_block_upload() -> Master:
    return canopen("up")


def canopen_block_download() -> Master:
    return canopen("down")


MASTERS: dict[str, Callable[[], Master]] = {
    made.__name__: made
    for made in (
        pymodbus_tcp, pymodbus_rtu, pymodbus_ascii, pymodbus_async_tcp, pymodbus_async_rtu, minimalmodbus_rtu,
        minimalmodbus_ascii, modbus_tk_tcp, modbus_tk_rtu, pymodbustcp, umodbus_tcp,
        canopen, canopen_block_upload, canopen_block_download,
    )
}  # fmt: skip


async def main() -> None:
    read, again = MASTERS[sys.argv[1]]()
    while True:
        try:
            value = await _result(read())
            if value is not None:
                print(value, flush=True)
        except Exception as e:  # any exception of the library, because the test is about whether it continues
            print(type(e).__name__, flush=True)
            await _result(again())
        await asyncio.sleep(PAUSE_S)


async def _result(value: Any) -> Any:
    return await value if inspect.isawaitable(value) else value


if __name__ == "__main__":
    asyncio.run(main())
