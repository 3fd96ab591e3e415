"""Values cached between two frames are dropped when their source changes: node, bus, master and driver.

A node that is run by its timer's callback also behaves like one with a separate task.
"""

from __future__ import annotations

import asyncio
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from canopen_slave_rig import NODE, RICH, U16, Rig, pdo, var

from fieldtwin.emulators.canopen.behaviour import DeviceModel, ModelOutput, Situation
from fieldtwin.emulators.canopen.eds.dictionary import parse_eds
from fieldtwin.emulators.canopen.node import CanopenNode, NodeContext
from fieldtwin.emulators.canopen.serve import serve_node
from fieldtwin.emulators.endpoints.can.bus_runner import BusRunner
from fieldtwin.emulators.endpoints.faulty.can import FaultyCan
from fieldtwin.emulators.faults.engine import WireFaults
from fieldtwin.emulators.faults.frames import Framing
from fieldtwin.emulators.virtual.clock import VirtualClock
from fieldtwin.emulators.virtual.loop import VirtualLoop
from fieldtwin.emulators.wires.can_bus import CanBus
from fieldtwin.emulators.wires.can_faults import spoil
from fieldtwin.gateway.core.can_error import CanErrorState
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.clock import NS_PER_MS
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.core.files.profile_file import load_profile
from fieldtwin.gateway.core.values import Reason, TagValue
from fieldtwin.gateway.devices.canopen_device import CanopenDriver
from fieldtwin.gateway.devices.config import DeviceConfig
from fieldtwin.gateway.protocols.canopen.configure import PdoConfig
from fieldtwin.gateway.protocols.canopen.master import CanopenMaster
from fieldtwin.gateway.protocols.canopen.nmt.heartbeat import HeartbeatConsumer
from fieldtwin.gateway.protocols.canopen.nmt.states import NmtState
from fieldtwin.gateway.protocols.canopen.pdo.mapping import PdoMapping

BUS_OFF = CanErrorState.BUS_OFF
WHERE = Endpoint.parse("can:fieldtwin/127.0.0.1:1")
PROFILE = load_profile(Path(__file__).parents[4] / "profiles" / "devices" / "inclinometer-cia410.yaml")


# -- the node -----------------------------------------------------------------------------------------------------------


def cyclic(ms: int) -> Rig:
    """OPERATIONAL, TPDO1 every so many ms, after all frames of the start."""
    rig = Rig()
    assert rig.write(0x1800, 5, ms, 2) == ""
    rig.nmt(1)
    return rig


def test_an_event_timer_that_the_device_changes_itself_is_heeded_from_the_next_one_on() -> None:
    rig = cyclic(100)
    assert [at for at, _ in rig.advance(250)] == [100, 200]
    rig.node.set_value(0x1800, 5, (20).to_bytes(2, "little"), rig.now_ns)
    assert [at for at, _ in rig.advance(100)] == [50, 70, 90]


def test_a_tpdo_that_the_device_itself_makes_synchronous_is_no_longer_sent_by_time() -> None:
    rig = cyclic(100)
    rig.advance(150)
    rig.node.set_value(0x1800, 2, b"\x01", rig.now_ns)  # it was not written, so no hook reports it
    assert rig.advance(500) == []
    assert len(rig.node.set_value(0x1800, 2, b"\xfe", rig.now_ns)) == 1  # it became due meanwhile


def test_a_new_mapping_is_sent_and_watched() -> None:
    rig = cyclic(100)
    assert rig.send(0x180 + NODE, remote=True) == ["185#00000000"]
    for index, sub, value, size in (
        (0x1800, 1, 0x80000185, 4), (0x1A00, 0, 0, 1), (0x1A00, 1, 0x20020010, 4), (0x1A00, 0, 1, 1), (0x1800, 1, 0x185, 4),
    ):  # fmt: skip
        assert rig.write(index, sub, value, size) == ""
    assert rig.send(0x180 + NODE, remote=True) == ["185#0000"]
    assert [str(f) for f in rig.node.set_value(0x2002, 0, b"\x07\x00", rig.now_ns)] == ["185#0700"]
    assert rig.node.set_value(0x2000, 0, b"\x08\x00", rig.now_ns) == []  # no longer mapped


def test_parts_of_objects_are_cut_out_of_them() -> None:
    """A BOOLEAN mapped by its one bit is not a whole object: the next one begins in the same byte."""
    text = RICH.replace(pdo("1800", "1A00", "$NODEID+0x180", 254, [0x20000010, 0x20020010]), "")
    text += var("2020", 1, "ro", 1, 1) + var("2021", U16, "ro", 3, 1)
    rig = Rig(text + pdo("1800", "1A00", "$NODEID+0x180", 254, [0x20200001, 0x20210010]))
    assert rig.nmt(1) == ["185#070000"]


def test_a_heartbeat_of_another_period_is_sent_at_its_time() -> None:
    rig = Rig()
    rig.write(0x1017, 0, 100, 2)
    assert [at for at, _ in rig.advance(250)] == [100, 200]
    assert rig.node.set_value(0x1017, 0, (30).to_bytes(2, "little"), rig.now_ns) == []
    assert [at for at, _ in rig.advance(120)] == [50, 80, 110]


def test_a_mute_node_requests_nothing_that_it_could_not_send() -> None:
    rig = cyclic(100)
    rig.node.raise_error(0x5000, rig.now_ns)
    due_ns = rig.node.wake_at_ns()
    assert due_ns is not None
    rig.node._core.mutes.add("a test")
    assert rig.node.wake_at_ns() is None
    rig.node._core.mutes.clear()
    assert rig.node.wake_at_ns() == due_ns


class Mirror(DeviceModel):
    """Show 2006h in 2002h, and its number of reads in 6000h."""

    def __init__(self) -> None:
        self.steps = 0

    def power_on(self, situation: Situation) -> None:
        pass

    def step(self, situation: Situation) -> ModelOutput:
        self.steps += 1
        return ModelOutput({(0x2002, 0): situation.objects.number(0x2006)}, {(0x6000, 0): self.steps})


def test_a_model_sees_the_current_object_after_any_change() -> None:
    rig = Rig(context=NodeContext(model=Mirror()))
    assert rig.read(0x2002) == 7  # the data sheet's
    rig.write(0x2006, 0, 9, 2)
    assert rig.read(0x2002) == 9
    rig.node.set_value(0x2006, 0, (11).to_bytes(2, "little"), rig.now_ns)
    assert rig.read(0x2002) == 11
    rig.nmt(129)
    assert rig.read(0x2002) == 7


def test_errors_that_come_and_go_are_reported_to_the_model_at_its_next_step() -> None:
    model = Mirror()
    rig = Rig(context=NodeContext(model=model))
    before = model.steps
    rig.node.tick(rig.now_ns)
    assert model.steps == before
    rig.node.raise_error(0x5000, rig.now_ns)
    rig.node.tick(rig.now_ns)
    assert model.steps == before + 1
    rig.node.clear_error(0x5000, rig.now_ns)
    assert model.steps == before + 2


@pytest.mark.parametrize("number", [1, -1, 40_000, -40_000, 2.5, -3.5, float("inf"), float("-inf"), float("nan"), True])
def test_a_device_holds_a_number_within_its_type(number: float) -> None:
    class Says(Mirror):
        def step(self, situation: Situation) -> ModelOutput:
            return ModelOutput({(0x2000, 0): number, (0x2005, 0): number, (0x2007, 0): number, (0x7777, 0): number})

    data = Rig(context=NodeContext(model=Says())).node.data
    asked: dict[int, tuple[int, int]] = {
        0x2000: (-(1 << 15), (1 << 15) - 1),
        0x2005: (0, (1 << 64) - 1),
        0x2007: (0, 1),
    }
    for index, (low, high) in asked.items():
        if number != number:
            expected = 0
        elif number in (float("inf"), float("-inf")):
            expected = high if number > 0 else low
        else:
            expected = min(max(round(number), low), high)
        size = len(data.get(index))
        assert data.get(index) == expected.to_bytes(size, "little", signed=expected < 0)


# -- on the bus ---------------------------------------------------------------------------------------------------------


def delivered(bus: CanBus, sender: int, at_ms: int) -> tuple[int, ...]:
    """Return the receivers of a frame that `sender` sends."""
    bus.submit(sender, CanFrame(0x123), at_ms * NS_PER_MS)
    (delivery,) = bus.advance((at_ms + 5) * NS_PER_MS)
    return tuple(delivery.receivers)


def test_a_frame_goes_to_the_nodes_on_the_bus_at_its_start() -> None:
    bus = CanBus(125_000)
    a, b, c = (bus.join(0) for _ in range(3))
    assert delivered(bus, a, 0) == (b, c)
    assert delivered(bus, b, 10) == (a, c)
    d = bus.join(15 * NS_PER_MS)
    assert delivered(bus, a, 20) == (b, c, d)
    bus.leave(c, 25 * NS_PER_MS)
    assert delivered(bus, a, 30) == (b, d)
    bus.submit(a, CanFrame(0x123), 40 * NS_PER_MS)
    late = bus.join(40 * NS_PER_MS + 1)
    (delivery,) = bus.advance(45 * NS_PER_MS)
    assert tuple(delivery.receivers) == (b, d)
    assert delivered(bus, a, 50) == (b, d, late)


def test_a_node_that_left_with_frames_waiting_receives_nothing_meanwhile() -> None:
    bus = CanBus(125_000)
    a, b, c = (bus.join(0) for _ in range(3))
    delivered(bus, a, 0)
    bus.submit(b, CanFrame(0x200), 10 * NS_PER_MS)
    bus.submit(b, CanFrame(0x201), 10 * NS_PER_MS)
    bus.leave(b, 10 * NS_PER_MS)
    bus.submit(a, CanFrame(0x100), 10 * NS_PER_MS)
    assert [tuple(d.receivers) for d in bus.advance(20 * NS_PER_MS)] == [(c,), (a, c), (a, c)]


def test_a_node_in_bus_off_receives_nothing_until_it_is_back() -> None:
    bus = CanBus(125_000)
    a, b, c = (bus.join(0) for _ in range(3))
    assert delivered(bus, a, 0) == (b, c)
    bus.disturb(spoil(match=lambda frame: frame.can_id == 0x200, times=32))
    bus.submit(c, CanFrame(0x200), 10 * NS_PER_MS)
    off_ms = next(ms for ms in range(10, 40) if bus.advance(ms * NS_PER_MS) == [] and bus.error_state(c)[0] is BUS_OFF)
    assert delivered(bus, a, off_ms) == (b,)
    assert len(bus.advance(200 * NS_PER_MS)) == 1  # its own frame
    assert delivered(bus, a, 210) == (b, c)


def test_a_frame_is_stamped_and_not_changed_afterwards() -> None:
    frame = CanFrame(0x1ABCDEF, b"\x01\x02", extended=True)
    assert (frame.at(5).t_ns, frame.t_ns, frame.at(5).key()) == (5, 0, frame.key())


# -- the node on a bus, run by callbacks -------------------------------------------------------------------------------


def on_bus(node: CanopenNode, script: Any, *, queue_frames: int = 64, faulty: bool = False) -> None:
    """Serve `node` on a bus in virtual time, parallel to `script(bus, listener, task)`."""
    loop = VirtualLoop()

    async def main() -> None:
        bus = BusRunner(125_000, queue_frames=queue_frames)
        end = bus.attach(WHERE, "node")
        listener = bus.attach(WHERE, "listener")
        connection = FaultyCan(end, WireFaults(Framing.RAW), NODE) if faulty else end
        task = loop.create_task(serve_node(connection, node, VirtualClock(loop)))
        try:
            await script(bus, listener, task)
        finally:
            task.cancel()
            await asyncio.wait([task])
            await listener.aclose()
            await connection.aclose()

    loop.run_until_complete(main())


@pytest.mark.parametrize("faulty", [False, True])
def test_frames_without_room_are_sent_in_order_when_there_is_room(faulty: bool) -> None:
    """Eight TPDOs at one event, and room for two."""
    maps = [pdo(f"18{n:02X}", f"1A{n:02X}", f"0x{0x190 + n:X}", 254, [0x20020010]) for n in range(8)]
    text = RICH.split("[1800]")[0] + RICH[RICH.index("[2000]") :] + "".join(maps)
    node = CanopenNode(parse_eds(text), NODE)

    async def script(bus: BusRunner, listener: Any, task: asyncio.Task[None]) -> None:
        await listener.send(CanFrame(0, bytes([1, NODE])))
        await listener.send(CanFrame(0x600 + NODE, bytes.fromhex("2B 17 10 00 64 00 00 00")))  # a heartbeat each 100 ms
        heard = [await listener.recv() for _ in range(1 + 8 + 2 + 2)]
        ids = [frame.can_id for frame in heard]
        assert ids == [0x705, *range(0x190, 0x198), 0x585, 0x705, 0x705, 0x705]
        assert heard[-1].t_ns - heard[-2].t_ns == 100 * NS_PER_MS  # it is awake at its time again
        assert node.counters.frames_out == len(heard)

    on_bus(node, script, queue_frames=2, faulty=faulty)


def test_an_error_raised_in_a_nodes_timer_ends_it() -> None:
    calls = 0

    def source(now_ns: int) -> dict[tuple[int, int], bytes]:
        nonlocal calls
        calls += 1
        return {} if calls < 4 else {(0x2000, 0): b"too long for it"}

    node = CanopenNode(parse_eds(RICH), NODE, NodeContext(source=source))
    node.data.put(0x1800, 5, (100).to_bytes(2, "little"))
    start = node.start

    def start_cyclic(now_ns: int) -> list[CanFrame]:
        frames = start(now_ns)
        node.data.put(0x1800, 5, (100).to_bytes(2, "little"))
        return frames + node.feed(CanFrame(0, bytes([1, NODE])), now_ns)

    async def script(bus: BusRunner, listener: Any, task: asyncio.Task[None]) -> None:
        with pytest.raises(UsageError, match="wrong length"):
            await task

    node.start = start_cyclic  # type: ignore[method-assign]
    on_bus(node, script)
    assert calls == 4


# -- master and driver --------------------------------------------------------------------------------------------------


class Sink:
    """`fieldtwin.gateway.devices.driver.TagSink`."""

    def __init__(self) -> None:
        self.values: dict[str, Any] = {}

    def put(self, name: str, value: TagValue) -> None:
        self.values[name] = value.value

    def put_bad(self, names: list[str], reason: Reason) -> None:
        self.values |= dict.fromkeys(names, reason)


def test_another_scale_holds_for_the_next_frame() -> None:
    async def main() -> None:
        bus, clock, sink = BusRunner(125_000), VirtualClock(loop), Sink()
        ours, theirs = bus.attach(WHERE), bus.attach(WHERE)
        config = DeviceConfig("incl", PROFILE, "can0", NODE)
        driver, master = CanopenDriver(config, sink, clock), CanopenMaster(ours, clock)
        driver.attach_master(ours, master)
        mapping = PdoMapping.of([(0x6010, 0, 16), (0x6020, 0, 16)])
        driver._listen([PdoConfig(1, 0x185, True, 254, 100, mapping)])
        running = loop.create_task(master.run())
        for factor in (1, 10, 1):
            slope = PROFILE.tags["slope_long"]
            tags = PROFILE.tags | {"slope_long": replace(slope, scale=slope.scale * factor)}
            driver.reconfigure(replace(config, profile=replace(PROFILE, tags=tags)))
            await theirs.send(CanFrame(0x185, b"\x64\x00\x00\x00"))
            await clock.sleep_until_ns(loop.now_ns + 10 * NS_PER_MS)
            assert sink.values["incl.slope_long"] == pytest.approx(100 * slope.scale * factor)
        running.cancel()
        await asyncio.wait([running])

    loop = VirtualLoop()
    loop.run_until_complete(main())


def test_a_node_that_is_monitored_again_is_missed_after_its_own_time() -> None:
    """Its heartbeats change nothing, and the active timer belongs to a different node, far in the future."""
    lost: list[tuple[int, int]] = []

    async def main() -> None:
        bus, clock = BusRunner(125_000), VirtualClock(loop)
        ours, theirs = bus.attach(WHERE), bus.attach(WHERE)
        began_ns = loop.now_ns
        master = CanopenMaster(ours, clock)
        master.on_event = lambda e: (
            lost.append((e.node, (loop.now_ns - began_ns) // NS_PER_MS)) if "lost" in e.kind else None
        )
        master.add_node(6, heartbeat_consumer_ms=60_000)
        master.add_node(5, heartbeat_consumer_ms=0)
        running = loop.create_task(master.run())
        await theirs.send(CanFrame(0x706, b"\x05"))
        await theirs.send(CanFrame(0x705, b"\x05"))
        await clock.sleep_until_ns(began_ns + 10 * NS_PER_MS)
        master.add_node(5, heartbeat_consumer_ms=100)
        await theirs.send(CanFrame(0x705, b"\x05"))
        await clock.sleep_until_ns(began_ns + 1000 * NS_PER_MS)
        running.cancel()
        await asyncio.wait([running])

    loop = VirtualLoop()
    loop.run_until_complete(main())
    assert [node for node, _ in lost] == [5]
    assert 110 <= lost[0][1] <= 113


def test_a_heartbeat_like_the_last_one_counts_from_when_it_came() -> None:
    consumer = HeartbeatConsumer()
    consumer.monitor(5, 100)
    assert [e.kind for e in consumer.observe(5, b"\x05", 0)] == ["state"]
    assert consumer.observe(5, b"\x05", 90 * NS_PER_MS) == ()
    assert consumer.deadline_ns(5) == 190 * NS_PER_MS
    late = consumer.observe(5, b"\x05", 191 * NS_PER_MS)  # no check took place in between
    assert [e.kind for e in late] == ["heartbeat-lost", "heartbeat-back"]
    assert consumer.state(5) is NmtState.OPERATIONAL
    assert consumer.deadline_ns(7) is None
