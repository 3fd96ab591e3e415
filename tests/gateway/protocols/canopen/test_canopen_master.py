"""The CANopen master over a bus in memory: dispatch, NMT, heartbeats, PDOs, EMCY, and its end."""

from __future__ import annotations

import asyncio

import pytest
from canopen_master_bus import LoopClock, MemoryEnd, bus, frame, run_virtual, running
from support import eventually

from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.errors import ConnectionLost, ReplyTimeout, SdoAborted, UsageError
from fieldtwin.gateway.protocols.canopen.emcy import parse_emcy
from fieldtwin.gateway.protocols.canopen.master import CanopenMaster
from fieldtwin.gateway.protocols.canopen.nmt.states import NmtCommand, NmtState, NodeEvent
from fieldtwin.gateway.protocols.canopen.sdo.channel import NodeRestarted


class Bench:
    """A master, the other end of its bus, and its events."""

    def __init__(self) -> None:
        ours, self.node = bus()
        self.ours = ours
        self.events: list[NodeEvent] = []
        self.master = CanopenMaster(ours, LoopClock(), on_event=self.events.append)

    @property
    def kinds(self) -> list[str]:
        return [event.kind for event in self.events]

    async def send(self, *frames: str) -> None:
        """Let the master receive all of these."""
        before = self.master.counters.frames_in
        for text in frames:
            await self.node.send(frame(text))
        await eventually(lambda: self.master.counters.frames_in == before + len(frames))


async def serve(end: MemoryEnd, values: dict[bytes, bytes]) -> None:
    """Answer expedited uploads of these multiplexors; abort others."""
    while True:
        request = (await end.recv()).data
        if request[0] == 0x40:
            value = values.get(request[1:4])
            if value is None:
                reply = b"\x80" + request[1:4] + bytes.fromhex("00000206")
            else:
                reply = bytes([0x43 | (4 - len(value)) << 2]) + request[1:4] + value.ljust(4, b"\0")
            await end.send(CanFrame(0x585, reply))


# -- NMT -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("command", "node", "expected"),
    [
        (NmtCommand.START, 5, "000#0105"),
        (NmtCommand.STOP, 5, "000#0205"),
        (NmtCommand.ENTER_PRE_OPERATIONAL, 127, "000#807F"),
        (NmtCommand.RESET_NODE, 0, "000#8100"),
        (NmtCommand.RESET_COMMUNICATION, 1, "000#8201"),
    ],
)
def test_nmt_commands_are_sent_as_frames(command: NmtCommand, node: int, expected: str) -> None:
    async def main() -> None:
        bench = Bench()
        await bench.master.nmt(command, node)
        assert (await bench.node.recv()).key() == frame(expected).key()
        assert bench.master.counters.frames_out == 1

    run_virtual(main())


def test_nmt_to_no_node_is_refused() -> None:
    async def main() -> None:
        with pytest.raises(UsageError, match="1 to 127"):
            await Bench().master.nmt(NmtCommand.START, 128)

    run_virtual(main())


# -- heartbeats ----------------------------------------------------------------------------------------------------


def test_co036_monitoring_starts_at_the_first_heartbeat_and_loss_is_reported_once() -> None:
    async def main() -> None:
        bench = Bench()
        bench.master.add_node(5, heartbeat_consumer_ms=1500)
        async with running(bench.master):
            await asyncio.sleep(10)
            assert bench.events == []
            await bench.send("705#05")
            heard = bench.events[0].t_ns
            assert bench.kinds == ["state"]
            assert bench.master.node_state(5) is NmtState.OPERATIONAL
            await asyncio.sleep(10)
            assert bench.kinds == ["state", "heartbeat-lost"]
            late_ns = bench.events[-1].t_ns - heard
            assert 1_500_000_000 <= late_ns <= 1_510_000_000
            assert bench.master.heartbeat_lost(5)
            await bench.send("705#05")
            assert bench.kinds == ["state", "heartbeat-lost", "heartbeat-back"]
            assert not bench.master.heartbeat_lost(5)

    run_virtual(main())


def test_co037_a_late_heartbeat_inside_the_consumer_time_is_not_an_event() -> None:
    async def main() -> None:
        bench = Bench()
        bench.master.add_node(5, heartbeat_consumer_ms=1500)
        async with running(bench.master):
            for _ in range(20):
                await bench.send("705#7F")
                await asyncio.sleep(1.49)
            assert bench.kinds == ["state"]
            assert bench.master.counters.heartbeats == 20

    run_virtual(main())


def test_co038_a_restart_while_lost_keeps_monitoring() -> None:
    async def main() -> None:
        bench = Bench()
        bench.master.add_node(5, heartbeat_consumer_ms=1000)
        async with running(bench.master):
            await bench.send("705#05")
            await asyncio.sleep(2)
            await bench.send("705#00")
            assert bench.kinds == ["state", "heartbeat-lost", "boot-up"]
            await bench.send("705#7F")
            assert bench.kinds[3:] == ["heartbeat-back", "state"]
            await asyncio.sleep(2)
            assert bench.kinds[5:] == ["heartbeat-lost"]

    run_virtual(main())


def test_a_node_that_boots_and_dies_at_once_is_lost_too() -> None:
    async def main() -> None:
        bench = Bench()
        bench.master.add_node(5, heartbeat_consumer_ms=1000)
        async with running(bench.master):
            await bench.send("705#05", "705#00")
            await asyncio.sleep(2)
            assert bench.kinds == ["state", "boot-up", "heartbeat-lost"]

    run_virtual(main())


def test_watching_can_start_later_and_stop() -> None:
    async def main() -> None:
        bench = Bench()
        async with running(bench.master):
            await bench.send("705#05")
            await asyncio.sleep(10)
            bench.master.add_node(5, heartbeat_consumer_ms=1000)
            await asyncio.sleep(10)
            assert bench.kinds == ["state"]
            await bench.send("705#05")
            bench.master.add_node(5, heartbeat_consumer_ms=200)
            await asyncio.sleep(0.3)
            assert bench.kinds == ["state", "heartbeat-lost"]
            bench.master.add_node(5)
            assert not bench.master.heartbeat_lost(5)
            await asyncio.sleep(10)
            assert bench.kinds == ["state", "heartbeat-lost"]

    run_virtual(main())


def test_a_heartbeat_that_waits_unread_is_not_late() -> None:
    async def main() -> None:
        bench = Bench()
        bench.master.add_node(5, heartbeat_consumer_ms=1000)
        async with running(bench.master):
            await bench.send("705#05")
            heard = bench.events[0].t_ns
            clock = LoopClock()
            await clock.sleep_until_ns(heard + 950_000_000)
            # A heartbeat of 0.9 s is in the stream; the reader is busy elsewhere and is not woken until 1.3 s.
            bench.ours.inbound.write(CanFrame(0x705, b"\x05", t_ns=heard + 900_000_000))
            await clock.sleep_until_ns(heard + 1_300_000_000)
            assert bench.master.counters.heartbeats == 1
            assert bench.kinds == ["state"]
            bench.ours._wake()
            await clock.sleep_until_ns(heard + 1_800_000_000)
            assert bench.kinds == ["state"]
            await clock.sleep_until_ns(heard + 2_000_000_000)
            assert bench.kinds == ["state", "heartbeat-lost"]

    run_virtual(main())


@pytest.mark.parametrize("text", ["705#", "705#01", "705#85", "705#0505"])
def test_co039_an_invalid_heartbeat_is_ignored_and_counted(text: str) -> None:
    async def main() -> None:
        bench = Bench()
        async with running(bench.master):
            await bench.send(text)
        assert bench.events == []
        assert bench.master.node_state(5) is None
        assert (bench.master.counters.heartbeats, bench.master.counters.ignored) == (0, 1)

    run_virtual(main())


def test_co035_an_unrequested_boot_up_is_unexpected() -> None:
    async def main() -> None:
        bench = Bench()
        async with running(bench.master):
            await bench.send("705#00")  # power on: the first one received
            await asyncio.sleep(1)
            await bench.master.nmt(NmtCommand.RESET_NODE, 5)
            await bench.send("705#00")
            await asyncio.sleep(1)
            await bench.send("705#00")
        assert [(e.kind, e.unexpected) for e in bench.events] == [
            ("boot-up", False),
            ("boot-up", False),
            ("boot-up", True),
        ]

    run_virtual(main())


def test_co034_a_storm_of_boot_ups_is_seen_node_by_node() -> None:
    async def main() -> None:
        bench = Bench()
        async with running(bench.master):
            await bench.master.nmt(NmtCommand.RESET_NODE, 0)
            await bench.send(*(f"{0x700 + node:X}#00" for node in range(1, 128)))
        assert [e.node for e in bench.events] == list(range(1, 128))
        assert set(bench.kinds) == {"boot-up"}

    run_virtual(main())


def test_co042_two_boot_ups_at_once_are_a_conflict() -> None:
    async def main() -> None:
        bench = Bench()
        async with running(bench.master):
            await bench.master.nmt(NmtCommand.RESET_NODE, 5)
            await bench.send("705#00")
            await asyncio.sleep(0.02)
            await bench.send("705#00")
        assert bench.kinds == ["boot-up", "boot-up", "conflict"]

    run_virtual(main())


# -- SDO -----------------------------------------------------------------------------------------------------------


def test_sdo_is_serial_on_a_node_and_concurrent_over_nodes() -> None:
    async def main() -> None:
        bench = Bench()
        async with running(bench.master):
            tasks = [asyncio.ensure_future(bench.master.sdo_upload(n, 0x1000, s)) for n in (5, 6) for s in (0, 1)]
            first = [(await bench.node.recv()) for _ in range(2)]
            assert sorted((f.can_id, f.data[3]) for f in first) == [(0x605, 0), (0x606, 0)]
            assert not bench.node.inbound.data_stream
            await bench.send("586#4F00100066000000", "585#4F00100055000000")
            second = [(await bench.node.recv()) for _ in range(2)]
            assert sorted((f.can_id, f.data[3]) for f in second) == [(0x605, 1), (0x606, 1)]
            await bench.send("585#4F00100156000000", "586#4F00100167000000")
            assert await asyncio.gather(*tasks) == [b"\x55", b"\x56", b"\x66", b"\x67"]
            assert (bench.master.counters.sdo_requests, bench.master.counters.sdo_replies) == (4, 4)

    run_virtual(main())


def test_errors_name_their_place_and_are_counted() -> None:
    async def main() -> None:
        bench = Bench()
        async with running(bench.master):
            serving = asyncio.ensure_future(serve(bench.node, {b"\x00\x10\x00": b"\x92\x01\x02\x00"}))
            assert await bench.master.sdo_upload(5, 0x1000, 0) == b"\x92\x01\x02\x00"
            with pytest.raises(SdoAborted, match="can:memory/test node 5: SDO 2000h:07 aborted with 06020000h"):
                await bench.master.sdo_upload(5, 0x2000, 7)
            with pytest.raises(ReplyTimeout, match="node 6: SDO 1000h:00"):
                await bench.master.sdo_upload(6, 0x1000, 0, 0.1)
            serving.cancel()
            await asyncio.gather(serving, return_exceptions=True)
        c = bench.master.counters
        assert (c.sdo_requests, c.sdo_replies, c.sdo_aborts, c.sdo_timeouts) == (3, 1, 1, 1)
        assert c.frames_out == 4  # the abort of the one that timed out

    run_virtual(main())


@pytest.mark.parametrize("later", [0.0, 0.3])
def test_co042_a_second_answer_is_a_conflict(later: float) -> None:
    async def main() -> None:
        bench = Bench()
        async with running(bench.master):
            asked = asyncio.ensure_future(bench.master.sdo_upload(5, 0x1000, 0))
            await bench.node.recv()
            await bench.node.send(frame("585#4F00100055000000"))
            await asyncio.sleep(later)
            await bench.node.send(frame("585#4F00100077000000"))
            assert await asked == b"\x55"
            await eventually(lambda: bench.kinds == ["conflict"])

    run_virtual(main())


def test_co063_a_bus_that_takes_no_frames_is_a_time_out_and_kills_no_task() -> None:
    async def main() -> None:
        bench = Bench()
        async with running(bench.master) as reader:
            bench.ours.room.clear()
            with pytest.raises(ReplyTimeout, match="could not be sent"):
                await bench.master.sdo_upload(5, 0x1000, 0)
            assert not reader.done()
            bench.ours.room.set()
            serving = asyncio.ensure_future(serve(bench.node, {b"\x00\x10\x00": b"\x01"}))
            assert await bench.master.sdo_upload(5, 0x1000, 0) == b"\x01"
            serving.cancel()
            await asyncio.gather(serving, return_exceptions=True)

    run_virtual(main())


def test_a_lost_bus_fails_waiting_and_later_requests_at_once() -> None:
    async def main() -> None:
        bench = Bench()
        async with running(bench.master) as reader:
            asked = asyncio.ensure_future(bench.master.sdo_upload(5, 0x1000, 0, 3600))
            queued = asyncio.ensure_future(bench.master.sdo_upload(5, 0x1000, 0, 3600))
            await bench.node.recv()
            bench.ours.feed_lost(ConnectionLost("bus-off"))
            for task in (asked, queued, reader):
                with pytest.raises(ConnectionLost, match="bus-off"):
                    await task
            with pytest.raises(ConnectionLost):
                await bench.master.sdo_upload(6, 0x1000, 0)
        assert LoopClock().monotonic_ns() < 60e9

    run_virtual(main())


def test_a_boot_up_ends_the_transfer_under_way_and_it_is_asked_again_at_once() -> None:
    """The node will never answer a request that it forgot: the master does not wait for it, and expects no late reply."""

    async def main() -> None:
        bench = Bench()
        async with running(bench.master):
            first = asyncio.ensure_future(bench.master.sdo_upload(5, 0x1018, 4, 10.0))
            assert (await bench.node.recv()).can_id == 0x605
            start = asyncio.get_running_loop().time()
            await bench.send("705#00")
            with pytest.raises(NodeRestarted, match="the node restarted"):
                await first
            retried = asyncio.ensure_future(bench.master.sdo_upload(5, 0x1018, 4, 10.0, retries=1))
            await bench.node.recv()
            await bench.send("705#00")
            assert (await bench.node.recv()).data[:4] == bytes.fromhex("40181004")  # again, without a probe
            await bench.send("585#4318100478563412")
            assert await retried == bytes.fromhex("78563412")
            assert asyncio.get_running_loop().time() - start < 0.1
            assert (bench.master.counters.sdo_probes, bench.master.counters.sdo_timeouts) == (0, 0)

    run_virtual(main())


def test_a_cancelled_master_leaves_no_request_waiting() -> None:
    async def main() -> None:
        bench = Bench()
        async with running(bench.master):
            asked = asyncio.ensure_future(bench.master.sdo_upload(5, 0x1000, 0, 3600))
            await bench.node.recv()
        with pytest.raises(ConnectionLost, match="stopped"):
            await asked

    run_virtual(main())


# -- PDO and EMCY --------------------------------------------------------------------------------------------------


def test_pdos_reach_their_subscribers_with_their_time() -> None:
    async def main() -> None:
        bench = Bench()
        seen: list[tuple[bytes, int]] = []

        def take(data: bytes, t_ns: int) -> None:
            seen.append((data, t_ns))

        bench.master.subscribe_pdo(0x185, take)
        async with running(bench.master):
            await bench.send("185#01020304", "186#05")
            assert seen == [(b"\x01\x02\x03\x04", 1_000_000_000)]
            assert (bench.master.counters.pdos, bench.master.counters.ignored) == (1, 1)
            bench.master.unsubscribe_pdo(0x185, take)
            await bench.send("185#01020304")
            assert len(seen) == 1

    run_virtual(main())


@pytest.mark.parametrize("cob_id", [0, 0x80, 0x85, 0x180, 0x585, 0x605, 0x705, 0x800])
def test_a_pdo_cannot_take_the_identifier_of_another_service(cob_id: int) -> None:
    with pytest.raises(UsageError):
        Bench().master.subscribe_pdo(cob_id, lambda data, t_ns: None)


def test_co060_extended_remote_and_error_frames_are_ignored() -> None:
    async def main() -> None:
        bench = Bench()
        bench.master.subscribe_pdo(0x185, lambda data, t_ns: pytest.fail("not a PDO"))
        async with running(bench.master):
            await bench.node.send(CanFrame(0x705, b"\x05", extended=True))
            await bench.node.send(CanFrame(0x185, remote=True, dlc=4))
            await bench.node.send(CanFrame(0x705, b"\x05", error=True))
            for text in ("080#", "000#0105", "100#000000000000"):
                await bench.node.send(frame(text))
            await eventually(lambda: bench.master.counters.frames_in == 6)
        assert bench.events == []
        assert bench.master.counters.ignored == 6

    run_virtual(main())


def test_emcy_reaches_the_events_and_short_ones_are_tolerated() -> None:
    async def main() -> None:
        bench = Bench()
        async with running(bench.master):
            await bench.send("085#3081110102030405", "085#0010", "085#10", "085#")
        assert bench.kinds == ["emcy", "emcy"]
        full, short = (parse_emcy(event.data) for event in bench.events)
        assert (full.code, full.register, full.vendor) == (0x8130, 0x11, b"\x01\x02\x03\x04\x05")
        assert full.meaning == "life guard error or heartbeat error"
        assert (short.code, short.register, short.vendor, short.length) == (0x1000, None, b"", 2)
        assert not short.is_reset
        assert (bench.master.counters.emcys, bench.master.counters.ignored) == (2, 2)

    run_virtual(main())


def test_a_callbacks_error_is_not_hidden() -> None:
    async def main() -> None:
        bench = Bench()

        def broken(data: bytes, t_ns: int) -> None:
            raise ZeroDivisionError

        bench.master.subscribe_pdo(0x185, broken)
        async with running(bench.master) as reader:
            await bench.node.send(frame("185#00"))
            with pytest.raises(ZeroDivisionError):
                await reader

    run_virtual(main())
