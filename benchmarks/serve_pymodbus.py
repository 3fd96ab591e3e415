"""pymodbus's server as a benchmark's peer: 100 holding registers on Modbus TCP.  serve_pymodbus.py PORT [SERVERS]

With SERVERS, it runs this number of servers in one process, each on a free port.
"""

from __future__ import annotations

import asyncio
import sys

from pymodbus.server import ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice


async def main(port: int, servers: int) -> None:
    made = []
    for _ in range(servers):
        device = SimDevice(1, [SimData(0, count=100, values=0, datatype=DataType.REGISTERS)])
        server = ModbusTcpServer(device, address=("127.0.0.1", port))
        await server.serve_forever(background=True)
        made.append(server)
    print("ready", flush=True)
    await asyncio.Event().wait()


if __name__ == "__main__":
    asyncio.run(main(int(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 1))
