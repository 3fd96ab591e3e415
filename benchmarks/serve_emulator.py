"""The emulator as a benchmark's server: 100 holding registers on Modbus TCP.  serve_emulator.py PORT [--uvloop]"""

from __future__ import annotations

import asyncio
import sys

from fieldtwin.emulators.endpoints.modbus_server import serve_mbap
from fieldtwin.emulators.endpoints.socket_end import SocketListener
from fieldtwin.emulators.modbus.bank import CellSpan, MapBank
from fieldtwin.emulators.modbus.mbap import MbapServer
from fieldtwin.emulators.modbus.unit import ModbusUnit
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.wallclock import WallClock


async def main(port: int) -> None:
    units = {1: ModbusUnit(MapBank([CellSpan("holding", 0, 100)]))}
    clock = WallClock()
    endpoint = Endpoint.parse(f"tcp://127.0.0.1:{port}")
    listener = await SocketListener.open(endpoint, lambda c: serve_mbap(c, MbapServer(units), clock), 256)
    print("ready", flush=True)
    try:
        await asyncio.Event().wait()
    finally:
        await listener.aclose()


if __name__ == "__main__":
    if "--uvloop" in sys.argv:
        import uvloop

        uvloop.install()
    asyncio.run(main(int(sys.argv[1])))
