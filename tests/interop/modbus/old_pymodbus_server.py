"""A TCP server of pymodbus 3.9.2 in a separate program, with the units of its first argument (``5,9``). It prints its
port.

This release answers a request to a unit that it does not have as unit 0, with function 80h and exception 0B.
"""

from __future__ import annotations

import asyncio
import logging
import sys
from typing import Any

from pymodbus import datastore
from pymodbus.server import ModbusTcpServer


async def main() -> None:
    logging.getLogger("pymodbus.logging").setLevel(logging.CRITICAL)
    old: Any = datastore  # names of the old release
    block = old.ModbusSequentialDataBlock
    units = {int(unit): old.ModbusSlaveContext(hr=block(1, [17] * 100)) for unit in sys.argv[1].split(",")}
    context: Any = old.ModbusServerContext(slaves=units, single=False)
    server = ModbusTcpServer(context, address=("127.0.0.1", 0))
    await server.serve_forever(background=True)
    transport: Any = server.transport
    print(transport.sockets[0].getsockname()[1], flush=True)
    await asyncio.Event().wait()


if __name__ == "__main__":
    asyncio.run(main())
