"""The site `shed` as a plant: a run that allows writes, an emulated device on a socket, and a relay that counts requests."""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

from procs import Fieldtwin, fieldtwin, free_port, wait_for
from pyModbusTCP.client import ModbusClient

WITHIN_S = 60.0
READS = {1, 2, 3, 4, 0x2B}
"""Function codes of Modbus requests that change nothing."""
COMMISSIONING_READS = READS | {7, 8, 0x0B, 0x0C, 0x11}
"""Those that `fieldtwin dump` and `fieldtwin identify` also send. Diagnostics (08h) depend on their sub-function."""
READ_DIAGNOSTICS = {0, 2, *range(0x0B, 0x13)}
"""The sub-functions of the diagnostics that change nothing (AP 6.8.1)."""


class Bus:
    """A relay between the gateway and the emulated device, which counts the requests by function code."""

    def __init__(self, device_port: int) -> None:
        self.requests: Counter[int] = Counter()
        self.diagnostics: set[int] = set()
        """The sub-functions of the diagnostics (08h) that were requested."""
        self._device_port = device_port

    @asynccontextmanager
    async def serving(self) -> AsyncIterator[int]:
        server = await asyncio.start_server(self._serve, "127.0.0.1", 0)
        try:
            yield server.sockets[0].getsockname()[1]
        finally:
            server.close()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        device_reader, device_writer = await asyncio.open_connection("127.0.0.1", self._device_port)
        back = asyncio.ensure_future(self._pass_back(device_reader, writer))
        try:
            while True:
                header = await reader.readexactly(6)
                body = await reader.readexactly(int.from_bytes(header[4:6], "big"))
                self.requests[body[1]] += 1
                if body[1] == 8:
                    self.diagnostics.add(int.from_bytes(body[2:4], "big"))
                device_writer.write(header + body)
        except (asyncio.IncompleteReadError, ConnectionError):
            pass
        finally:
            back.cancel()
            device_writer.close()
            writer.close()

    async def _pass_back(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        while data := await reader.read(4096):
            writer.write(data)


def registers(port: int) -> list[list[int]]:
    """The registers that the device holds, read by a different client."""
    client = ModbusClient("127.0.0.1", port, unit_id=1, auto_open=True, auto_close=True)
    return [client.read_input_registers(0, 1) or [], client.read_holding_registers(0, 1) or []]


@asynccontextmanager
async def emulated_device(root: Path, project: Path) -> AsyncIterator[tuple[Bus, int]]:
    """The tank on a socket: the relay to which the bus of shed.yaml leads, and the port of the tank itself."""
    port = free_port()
    bus = Bus(port)
    with fieldtwin(
        root, "emulate", str(project / "tank.yaml"), "--on", f"tcp://127.0.0.1:{port}", name="emulate"
    ) as device:
        await asyncio.to_thread(wait_for, lambda: str(port) in device.out + device.err, WITHIN_S, "the emulated device")
        async with bus.serving() as relay:
            system = project / "shed.yaml"
            system.write_text(system.read_text().replace("tank:502", f"127.0.0.1:{relay}"))
            yield bus, port


@asynccontextmanager
async def plant(root: Path, project: Path) -> AsyncIterator[tuple[Fieldtwin, Bus, int]]:
    """The site as a plant that allows writes, against an emulated device on a socket."""
    async with emulated_device(root, project) as (bus, port):
        with fieldtwin(root, "run", str(project / "shed.yaml"), "--plant", "--allow-writes") as run:
            await asyncio.to_thread(wait_for, (root / "shed" / "gateway.sock").is_socket, WITHIN_S, "the gateway")
            yield run, bus, port
