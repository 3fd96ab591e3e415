"""The rows of the CANopen master repeated in real time on real wires: the kernel's vcan, and the software bus over TCP.

The order of the frames and their effects count here; times are stretched and only lower bounds. Rows are omitted if they need
millisecond times, or a bus that can be filled or cut.
"""

from __future__ import annotations

import asyncio
import tomllib
from pathlib import Path
from typing import Any

import pytest
from support import eventually, run

from fieldtwin.emulators.endpoints.can.bus_server import SoftBusServer
from fieldtwin.emulators.endpoints.can.software_end import open_can_end
from fieldtwin.gateway.connections.os_connector import OsConnector
from fieldtwin.gateway.core import errors
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.protocols.canopen.cob_id import LSS_REPLY
from fieldtwin.gateway.protocols.canopen.lss.frames import LssAddress, LssRefused
from fieldtwin.gateway.protocols.canopen.lss.master import LssMaster
from fieldtwin.gateway.protocols.canopen.master import CanopenMaster
from fieldtwin.gateway.protocols.canopen.nmt.states import NmtCommand, NodeEvent
from fieldtwin.gateway.wallclock import WallClock

ROWS = tomllib.loads((Path(__file__).parents[2] / "vectors" / "canopen_master.toml").read_text())["row"]
BITRATE = 125_000
SCALE = 5
"""Factor by which times are stretched, because a shared machine is late at times."""
TO_THE_MILLISECOND = ("CO-018", "CO-024")
CALLS = ("upload", "download", "nmt", "lss-any", "lss-fastscan", "lss-node-id", "lss-store", "lss-assign")


def playable(row: dict[str, Any]) -> bool:
    """Return whether a row needs nothing but a wire."""
    late = max([float(line.split()[0]) for line in row.get("bus", [])] + [row.get("until_ms", 0)], default=0)
    calls = all(call[1] in CALLS for call in row.get("do", []))
    plain = not row.get("driver") and not row.get("patience")
    return calls and late <= 1000 and plain and row["case"] not in TO_THE_MILLISECOND


PLAYABLE = [row for row in ROWS if playable(row)]
ON_TCP = [row for row in PLAYABLE if row["case"] in ("CO-001", "CO-016", "CO-019", "CO-034", "CO-058")]


def parse(text: str) -> CanFrame:
    can_id, _, data = text.partition("#")
    if data.startswith("R"):
        return CanFrame(int(can_id, 16), remote=True, dlc=int(data[1:]))
    return CanFrame(int(can_id, 16), bytes.fromhex(data), extended=len(can_id) == 8)


class WirePlay:
    """Connect the client to one end of the wire; the row drives the other end."""

    def __init__(self, row: dict[str, Any]) -> None:
        self.row = row
        self.events: list[str] = []

    async def play(self, endpoint: Endpoint) -> None:
        ours = await OsConnector().open_can(endpoint, BITRATE)
        theirs = await open_can_end(endpoint, BITRATE)
        settings = {"sdo_timeout_s": 0.1 * SCALE} | self.row.get("settings", {})
        self.master = CanopenMaster(ours, WallClock(), on_event=self.on_event, **settings)
        self.lss = LssMaster(self.master.send, WallClock(), reply_s=0.01 * SCALE)
        self.master.listen(LSS_REPLY, self.lss.on_reply)
        for node, consumer_ms in self.row.get("watch", []):
            self.master.add_node(node, heartbeat_consumer_ms=consumer_ms * SCALE)
        reading = asyncio.ensure_future(self.master.run())
        self.start_s = asyncio.get_running_loop().time()
        calls = [asyncio.ensure_future(self.ask(call)) for call in self.row.get("do", [])]
        try:
            fed = 0
            for line in self.row.get("bus", []):
                at_ms, direction, rest = line.split(" ", 2)
                text, _, times = rest.partition(" *")
                if direction == ">":
                    async with asyncio.timeout(10):
                        assert (await theirs.recv()).key() == parse(text).key()
                else:
                    await self.until(float(at_ms))
                    for _ in range(int(times or 1)):
                        await theirs.send(parse(text))
                        fed += 1
            results = await asyncio.gather(*calls)
            await eventually(lambda: self.master.counters.frames_in >= fed, within_s=10)
            assert results == [" ".join(r.split(" ")[1:]) for r in self.row.get("results", [])]
            if "events" in self.row:
                assert self.events == [" ".join(e.split(" ")[1:]) for e in self.row["events"]]
            for name, value in self.row.get("state", {}).items():
                assert getattr(self.master.counters, name) == value, name
            assert not theirs.inbound.data_stream, "nothing else is sent"
        finally:
            for task in (reading, *calls):
                task.cancel()
            await asyncio.gather(reading, *calls, return_exceptions=True)
            await ours.aclose()
            await theirs.aclose()

    async def until(self, at_ms: float) -> None:
        left_s = self.start_s + at_ms * SCALE / 1000 - asyncio.get_running_loop().time()
        await asyncio.sleep(max(0.0, left_s))

    def frames_before(self, at_ms: float) -> int:
        """Return how many frames the client received before a time of the row: a call waits for them, however late they are."""
        lines = [line.split(" ", 2) for line in self.row.get("bus", [])]
        received = [rest for time, direction, rest in lines if direction == "<" and float(time) < at_ms]
        return sum(int(rest.partition(" *")[2] or 1) for rest in received)

    def on_event(self, event: NodeEvent) -> None:
        self.events.append(f"{event.node} {event.kind}{' unexpected' if event.unexpected else ''}")

    async def ask(self, call: list[Any]) -> str:
        at_ms, name, *rest = call
        named = rest.pop() if rest and isinstance(rest[-1], dict) else {}
        await self.until(at_ms)
        await eventually(lambda: self.master.counters.frames_in >= self.frames_before(at_ms), within_s=20)
        try:
            return await self.call(name, rest, named)
        except errors.SdoAborted as e:
            return f"SdoAborted {e.code:08X}"
        except LssRefused as e:
            return f"LssRefused {e.code} {e.specific}"
        except errors.FieldtwinError as e:
            return type(e).__name__

    async def call(self, name: str, rest: list[Any], named: dict[str, Any]) -> str:
        if name == "upload":
            return (await self.master.sdo_upload(*rest, **named)).hex()
        if name == "lss-any":
            return str(await self.lss.any_unconfigured())
        if name == "lss-fastscan":
            return str(await self.lss.fastscan())
        if name == "download":
            await self.master.sdo_download(*rest[:3], bytes.fromhex(rest[3]), **named)
        elif name == "nmt":
            await self.master.nmt(NmtCommand[rest[0]], rest[1])
        elif name == "lss-node-id":
            await self.lss.configure_node_id(*rest)
        elif name == "lss-store":
            await self.lss.store()
        else:
            return str(await self.lss.assign(LssAddress(*rest[:4]), rest[4]))
        return "done"


def name_of(row: dict[str, Any]) -> str:
    return f"{row['case']} {row['title']}"


@pytest.mark.parametrize("row", ON_TCP, ids=name_of)
def test_row_on_the_software_bus(row: dict[str, Any]) -> None:
    async def main() -> None:
        server = await SoftBusServer.open(Endpoint.parse("can:fieldtwin/127.0.0.1:0"), BITRATE, paced=False)
        try:
            await WirePlay(row).play(server.bound)
        finally:
            await server.aclose()

    run(main())


@pytest.mark.socketcan
@pytest.mark.parametrize("row", PLAYABLE, ids=name_of)
def test_row_on_vcan(row: dict[str, Any]) -> None:
    run(WirePlay(row).play(Endpoint.parse("can:socketcan/vcan0")), timeout_s=60)


def test_most_rows_can_run() -> None:
    assert len(PLAYABLE) >= 40
