"""Third-party Python clients of the league: ``clients.py NAME``, with the endpoint in the environment.

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

TIMEOUT_S, PAUSE_S = float(os.environ.get("LEAGUE_TIMEOUT_S", "0.15")), 0.02
Client = tuple[Callable[[], Any], Callable[[], object]]
"""Read the value, `None` for a missing one, and reconnect; both functions may return an awaitable."""


def _tcp() -> tuple[str, int]:
    return os.environ["FIELDTWIN_HOST"], int(os.environ["FIELDTWIN_PORT"])


def _pymodbus(client: Any) -> Client:
    unit = _unit_argument(client)

    def read() -> int | None:
        reply = client.read_holding_registers(0, count=2, **unit)
        return None if reply.isError() else reply.registers[0]

    client.connect()
    return read, client.connect


def pymodbus_tcp() -> Client:
    from pymodbus.client import ModbusTcpClient

    host, port = _tcp()
    return _pymodbus(ModbusTcpClient(host, port=port, timeout=TIMEOUT_S, retries=0))


def _framer(name: str) -> Any:
    try:
        from pymodbus import FramerType
    except ImportError:  # pymodbus 3.0
        from pymodbus.framer.rtu_framer import ModbusRtuFramer

        return ModbusRtuFramer
    return FramerType(name)


def pymodbus_rtu(framer: str = "rtu") -> Client:
    from pymodbus.client import ModbusSerialClient

    tty, framing = os.environ["FIELDTWIN_TTY"], _framer(framer)
    return _pymodbus(ModbusSerialClient(tty, framer=framing, baudrate=19200, parity="N", timeout=TIMEOUT_S, retries=0))


def _unit_argument(client: Any) -> dict[str, int]:
    """Return the unit ID as a keyword argument: its name differs between pymodbus 3.0 and later versions."""
    new = "device_id" in inspect.signature(client.read_holding_registers).parameters
    return {"device_id" if new else "slave": 1}


def _pymodbus_async(client: Any) -> Client:
    unit = _unit_argument(client)

    async def read() -> int | None:
        if not client.connected:
            await client.connect()
        reply = await client.read_holding_registers(0, count=2, **unit)
        return None if reply.isError() else reply.registers[0]

    return read, client.connect


def pymodbus_async_tcp() -> Client:
    from pymodbus.client import AsyncModbusTcpClient

    host, port = _tcp()
    return _pymodbus_async(AsyncModbusTcpClient(host, port=port, timeout=TIMEOUT_S, retries=0))


def pymodbus_async_rtu() -> Client:
    from pymodbus.client import AsyncModbusSerialClient

    tty = os.environ["FIELDTWIN_TTY"]
    return _pymodbus_async(AsyncModbusSerialClient(tty, baudrate=19200, parity="N", timeout=TIMEOUT_S, retries=0))


def pymodbus_ascii() -> Client:
    return pymodbus_rtu("ascii")


def minimalmodbus_rtu(mode: str = "rtu") -> Client:
    import minimalmodbus

    device = minimalmodbus.Instrument(os.environ["FIELDTWIN_TTY"], 1, mode=mode)
    device.serial.baudrate, device.serial.timeout = 19200, TIMEOUT_S
    return lambda: device.read_registers(0, 2)[0], lambda: None


def minimalmodbus_ascii() -> Client:
    return minimalmodbus_rtu("ascii")


def modbus_tk_tcp() -> Client:
    from modbus_tk.modbus_tcp import TcpMaster

    host, port = _tcp()
    return _modbus_tk(TcpMaster(host, port, timeout_in_sec=TIMEOUT_S))


def modbus_tk_rtu() -> Client:
    from modbus_tk.modbus_rtu import RtuMaster
    from serial import Serial

    master = RtuMaster(Serial(os.environ["FIELDTWIN_TTY"], baudrate=19200))
    master.set_timeout(TIMEOUT_S)
    return _modbus_tk(master)


def _modbus_tk(master: Any) -> Client:
    """`open` does nothing while the library considers itself connected, like pymodbus's `connect`."""
    return lambda: master.execute(1, 3, 0, 2)[0], master.open


def pymodbustcp() -> Client:
    from pyModbusTCP.client import ModbusClient

    host, port = _tcp()
    client = ModbusClient(host=host, port=port, unit_id=1, timeout=TIMEOUT_S, auto_open=True)
    return lambda: (client.read_holding_registers(0, 2) or [None])[0], lambda: None


def umodbus_tcp() -> Client:
    import socket

    from umodbus.client import tcp

    link = [socket.create_connection(_tcp(), timeout=TIMEOUT_S)]

    def again() -> None:
        link[0].close()
        link[0] = socket.create_connection(_tcp(), timeout=TIMEOUT_S)

    return lambda: tcp.send_message(tcp.read_holding_registers(1, 0, 2), link[0])[0], again


def easymodbus_tcp() -> Client:
    from easymodbus.modbus_client import ModbusClient

    host, port = _tcp()
    client = ModbusClient(host, port)
    client.timeout = TIMEOUT_S

    def again() -> None:
        try:
            client.close()
        finally:
            client.connect()

    client.connect()
    return lambda: client.read_holding_registers(0, 2)[0], again


def async_modbus_tcp() -> Client:
    """The library has no timeout, so the program limits the wait and then opens a new connection."""
    from async_modbus import AsyncTCPClient

    link: list[Any] = []

    async def again() -> None:
        for _, writer in link:
            writer.close()
        link[:] = [await asyncio.open_connection(*_tcp())]

    async def read() -> int:
        if not link:
            await again()
        async with asyncio.timeout(TIMEOUT_S):
            return int((await AsyncTCPClient(link[0]).read_holding_registers(1, 0, 2))[0])

    return read, again


def modbuslink_tcp() -> Client:
    from modbuslink import SyncModbusClient, SyncTcpTransport

    host, port = _tcp()
    return _modbuslink(SyncModbusClient(SyncTcpTransport(host, port, timeout=TIMEOUT_S)))


def modbuslink_rtu() -> Client:
    from modbuslink import SyncModbusClient, SyncRtuTransport

    return _modbuslink(
        SyncModbusClient(SyncRtuTransport(os.environ["FIELDTWIN_TTY"], baudrate=19200, timeout=TIMEOUT_S))
    )


def _modbuslink(client: Any) -> Client:
    def again() -> None:
        if not client.transport.is_open():
            client.transport.open()

    again()
    return lambda: client.read_holding_registers(1, 0, 2)[0], again


def modbus_rs_tcp() -> Client:
    import modbus_rs

    def connect() -> Any:
        host, port = _tcp()
        return modbus_rs.TcpTransport.connect(host, port, timeout_ms=round(TIMEOUT_S * 1000))

    return _modbus_rs(connect)


def modbus_rs_rtu() -> Client:
    import modbus_rs

    def connect() -> Any:
        return modbus_rs.RtuTransport.open(
            os.environ["FIELDTWIN_TTY"], baud_rate=19200, timeout_ms=round(TIMEOUT_S * 1000), retry_attempts=0
        )

    return _modbus_rs(connect)


def _modbus_rs(connect: Callable[[], Any]) -> Client:
    link = [connect()]
    unit = [link[0].create_client(1)]

    def again() -> None:
        link[0].close()
        link[0] = connect()
        unit[0] = link[0].create_client(1)

    return lambda: unit[0].read_holding_registers(0, 2)[0], again


def aiomodbus_tcp() -> Client:
    from aiomodbus.tcp import ModbusTCPClient

    host, port = _tcp()
    client = ModbusTCPClient(host, port, default_unit_id=1, default_timeout=TIMEOUT_S, auto_reconnect_after=0.1)
    begun: list[bool] = []

    async def read() -> int:
        if not begun:
            begun.append(True)
            await client.connect()
        return int((await client.read_holding_registers(0, 2))[0])

    return read, lambda: None


def canopen_sync(block: str = "") -> Client:
    import canopen as library
    from can_line import LineBus
    from canopen.objectdictionary import ODVariable

    network = library.Network()
    network.bus = LineBus()
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


def canopen_block_upload() -> Client:
    return canopen_sync("up")


def canopen_block_download() -> Client:
    return canopen_sync("down")


def canopen_asyncio() -> Client:
    import canopen_asyncio as library
    from can_line import LineBus

    made: list[Any] = []

    async def read() -> int:
        if not made:
            network = library.Network()
            network.bus = LineBus()
            network.connect(loop=asyncio.get_running_loop())
            made.append(network.add_node(library.RemoteNode(5, library.ObjectDictionary())))
            made[0].sdo.RESPONSE_TIMEOUT = TIMEOUT_S
        return int.from_bytes(await made[0].sdo.aupload(0x2000, 0), "little")

    return read, lambda: None


CLIENTS: dict[str, Callable[[], Client]] = {
    made.__name__: made
    for made in (
        pymodbus_tcp, pymodbus_rtu, pymodbus_ascii, pymodbus_async_tcp, pymodbus_async_rtu, minimalmodbus_rtu,
        minimalmodbus_ascii, modbus_tk_tcp, modbus_tk_rtu, pymodbustcp, umodbus_tcp, easymodbus_tcp, async_modbus_tcp,
        modbuslink_tcp, modbuslink_rtu, modbus_rs_tcp, modbus_rs_rtu, aiomodbus_tcp,
        canopen_sync, canopen_block_upload, canopen_block_download, canopen_asyncio,
    )
}  # fmt: skip


async def main() -> None:
    read, again = CLIENTS[sys.argv[1]]()
    while True:
        try:
            value = await _result(read())
            if value is not None:
                print(value, flush=True)
        except (Exception, asyncio.CancelledError) as e:  # any one of the library: the test is whether it continues
            print(type(e).__name__, flush=True)
            try:
                await _result(again())
            except Exception as e:
                print(type(e).__name__, flush=True)
        await asyncio.sleep(PAUSE_S)


async def _result(value: Any) -> Any:
    return await value if inspect.isawaitable(value) else value


if __name__ == "__main__":
    asyncio.run(main())
