"""The rows of the list of CANopen edge cases that concern the master, each on the whole master.

A row of tests/vectors/canopen_master.toml has frames and times in, frames and times out, results, and the final state. It runs
in virtual time, so times are exact.
"""

from __future__ import annotations

import asyncio
import tomllib
from pathlib import Path
from typing import Any

import pytest
from canopen_master_bus import bus, frame
from modbus_virtual import VirtualLoop, run_virtually

from fieldtwin.gateway.core import errors
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.files.profile_file import load_profile
from fieldtwin.gateway.core.values import Reason, TagValue
from fieldtwin.gateway.devices.canopen_config import CanopenNodeConfig
from fieldtwin.gateway.devices.canopen_device import CanopenDriver
from fieldtwin.gateway.devices.config import DeviceConfig
from fieldtwin.gateway.protocols.canopen.cob_id import LSS_REPLY
from fieldtwin.gateway.protocols.canopen.configure import PdoConfig
from fieldtwin.gateway.protocols.canopen.emcy import parse_emcy
from fieldtwin.gateway.protocols.canopen.emcy_log import EmcyLog
from fieldtwin.gateway.protocols.canopen.lss.frames import LssAddress, LssRefused
from fieldtwin.gateway.protocols.canopen.lss.master import LssMaster
from fieldtwin.gateway.protocols.canopen.master import CanopenMaster
from fieldtwin.gateway.protocols.canopen.nmt.states import NmtCommand, NodeEvent
from fieldtwin.gateway.protocols.canopen.pdo.mapping import PdoMapping
from fieldtwin.gateway.protocols.canopen.pdo.sync import SyncProducer, TimeProducer

ROOT = Path(__file__).parents[4]
ROWS = tomllib.loads((ROOT / "tests" / "vectors" / "canopen_master.toml").read_text())["row"]
PROFILE = load_profile(ROOT / "profiles" / "devices" / "inclinometer-cia410.yaml")
NODE = 5
MS = 1_000_000


class Play:
    """One row: a master on a bus of two whose other end is the row, and its result."""

    def __init__(self, row: dict[str, Any]) -> None:
        self.row = row
        loop = asyncio.get_running_loop()
        assert isinstance(loop, VirtualLoop)
        self.loop = loop
        self.ours, self.theirs = bus()
        self.sent: list[str] = []
        self.events: list[str] = []
        self.tags: list[str] = []
        self.log = EmcyLog()
        self.calls: list[asyncio.Task[None]] = []
        self.results: list[str] = []
        settings = {"sdo_timeout_s": 0.1} | row.get("settings", {})
        self.master = CanopenMaster(self.ours, loop, on_event=self.on_event, **settings)
        self.lss = LssMaster(self.master.send, loop, reply_s=0.01)
        self.master.listen(LSS_REPLY, self.lss.on_reply)
        self.driver = self.make_driver() if row.get("driver") else None
        for node, consumer_ms in row.get("watch", []):
            self.master.add_node(node, heartbeat_consumer_ms=consumer_ms)
        for node, timeout_s, retries in row.get("patience", []):
            self.master.add_node(node, sdo_timeout_s=timeout_s, sdo_retries=retries)

    @property
    def ms(self) -> str:
        return f"{self.loop.monotonic_ns() / MS:g}"

    # -- the row's end of the bus -----------------------------------------------------------------------------------

    async def watch(self) -> None:
        while True:
            arrived = await self.theirs.recv()
            self.sent.append(f"{self.ms} > {arrived}")

    def arrive(self, line: str) -> None:
        at_ms, _, rest = line.split(" ", 2)
        text, _, times = rest.partition(" *")
        can_id, _, data = text.partition("#")
        if data.startswith("R"):
            arriving = CanFrame(int(can_id, 16), remote=True, dlc=int(data[1:]))
        elif len(can_id) == 8:
            arriving = CanFrame(int(can_id, 16), bytes.fromhex(data), extended=True)
        else:
            arriving = frame(text)
        for _ in range(int(times or 1)):
            self.loop.call_at(float(at_ms) / 1e3, self.ours.feed, arriving)

    # -- what is asked ------------------------------------------------------------------------------------------------

    async def ask(self, number: int, call: list[Any]) -> None:
        """One entry of `do`: when, what, arguments, and named ones in a table at the end."""
        at_ms, name, *rest = call
        named = rest.pop() if rest and isinstance(rest[-1], dict) else {}
        await self.loop.sleep_until_ns(round(at_ms * MS))
        try:
            outcome = await getattr(self, f"do_{name.replace('-', '_')}")(*rest, **named)
        except errors.SdoAborted as e:
            outcome = f"SdoAborted {e.code:08X}"
        except LssRefused as e:
            outcome = f"LssRefused {e.code} {e.specific}"
        except errors.FieldtwinError as e:
            outcome = type(e).__name__
        except asyncio.CancelledError:
            outcome = "cancelled"
        self.results[number] = f"{self.ms} {outcome}".rstrip()

    async def do_upload(self, node: int, index: int, sub: int, **named: Any) -> str:
        return (await self.master.sdo_upload(node, index, sub, **named)).hex()

    async def do_download(self, node: int, index: int, sub: int, data: str, **named: Any) -> str:
        await self.master.sdo_download(node, index, sub, bytes.fromhex(data), **named)
        return "done"

    async def do_nmt(self, command: str, node: int) -> str:
        await self.master.nmt(NmtCommand[command], node)
        return "done"

    async def do_cancel(self, number: int) -> str:
        self.calls[number].cancel()
        return "done"

    async def do_bus_full(self) -> str:
        self.ours.room.clear()
        return "done"

    async def do_bus_free(self) -> str:
        self.ours.room.set()
        return "done"

    async def do_lose_bus(self) -> str:
        self.ours.feed_lost(errors.ConnectionLost("bus-off"))
        return "done"

    async def do_sync(self, period_us: int, overflow: int, count: int) -> str:
        return await self.produce(SyncProducer(period_us, self.loop.monotonic_ns(), overflow=overflow), count)

    async def do_time(self, period_ms: int, utc_ns: int, count: int) -> str:
        return await self.produce(TimeProducer(period_ms, self.loop.monotonic_ns()), count, utc_ns)

    async def produce(self, producer: SyncProducer | TimeProducer, count: int, utc_ns: int = 0) -> str:
        while producer.sent < count:
            await self.loop.sleep_until_ns(producer.next_ns)
            now_ns = self.loop.monotonic_ns()
            due = producer.due(now_ns, utc_ns + now_ns)
            assert due is not None
            await self.master.send(due)
        return "done"

    async def do_lss_any(self) -> str:
        return str(await self.lss.any_unconfigured())

    async def do_lss_fastscan(self) -> str:
        return str(await self.lss.fastscan())

    async def do_lss_node_id(self, node: int) -> str:
        await self.lss.configure_node_id(node)
        return "done"

    async def do_lss_store(self) -> str:
        await self.lss.store()
        return "done"

    async def do_lss_assign(self, vendor: int, product: int, revision: int, serial: int, node: int) -> str:
        return str(await self.lss.assign(LssAddress(vendor, product, revision, serial), node))

    # -- what comes of it ---------------------------------------------------------------------------------------------

    def on_event(self, event: NodeEvent) -> None:
        self.events.append(f"{self.ms} {event.node} {event.kind}{' unexpected' if event.unexpected else ''}")
        if event.kind == "emcy":
            self.log.add(parse_emcy(event.data), event.t_ns)
        if self.driver is not None:
            self.driver.on_event(event)

    def make_driver(self) -> CanopenDriver:
        mapping = PdoMapping.of([(0x6010, 0, 16), (0x6020, 0, 16)])
        boot = CanopenNodeConfig(tpdos=(PdoConfig(1, 0x180 + NODE, True, 254, 100, mapping),))
        driver = CanopenDriver(DeviceConfig("incl", PROFILE, "can0", NODE, canopen=boot), self, self.loop)
        driver.attach_master(self.ours, self.master)
        return driver

    def put(self, name: str, value: TagValue) -> None:
        self.tags.append(f"{self.ms} {name} {value.value:g}")

    def put_bad(self, names: list[str], reason: Reason) -> None:
        self.tags.append(f"{self.ms} {', '.join(names)}: {reason}")

    async def all(self) -> None:
        if self.driver is not None:
            await self.driver.adopt()
        reading, watching = asyncio.ensure_future(self.master.run()), asyncio.ensure_future(self.watch())
        for line in self.row.get("bus", []):
            if line.split()[1] == "<":
                self.arrive(line)
        calls = self.row.get("do", [])
        self.results = [""] * len(calls)
        self.calls = [asyncio.ensure_future(self.ask(number, call)) for number, call in enumerate(calls)]
        await asyncio.gather(*self.calls, return_exceptions=True)
        lines = [float(line.split()[0]) for line in self.row.get("bus", [])]
        end_ms = max([*lines, self.row.get("until_ms", 0.0)]) + 1
        await self.loop.sleep_until_ns(round(end_ms * MS))
        for task in (reading, watching):
            task.cancel()
        await asyncio.gather(reading, watching, return_exceptions=True)
        self.judge()

    def judge(self) -> None:
        expected = [
            " > ".join(part.strip() for part in line.split(">")) for line in self.row.get("bus", []) if ">" in line
        ]
        expected = [line.split(" > ")[0] + " > " + str(frame(line.split(" > ")[1])) for line in expected]
        assert self.sent == expected
        assert self.results == self.row.get("results", ["0 done"] * len(self.results))
        for name in ("events", "tags"):
            if name in self.row:
                assert getattr(self, name) == self.row[name]
        for name, value in self.row.get("state", {}).items():
            assert getattr(self.master.counters, name) == value, name
        for name, value in self.row.get("log", {}).items():
            found: Any = getattr(self.log, name)
            assert (list(found) if name == "active" else found) == value, name
        if "newest" in self.row:
            assert [entry.emcy.meaning for entry in self.log.entries] == self.row["newest"]
        if "malformed" in self.row:
            assert self.driver is not None
            assert self.driver.malformed_pdos == self.row["malformed"]


@pytest.mark.parametrize("row", ROWS, ids=lambda row: f"{row['case']} {row['title']}")
def test_row_of_the_edge_cases_of_a_master(row: dict[str, Any]) -> None:
    async def main() -> None:
        await Play(row).all()

    run_virtually(main())
