"""Order of requests on a bus that polls, writes for the PLC and carries requests of bridge clients; and the queue itself."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

from gateway_rig import FieldBus, profile, running_bus, unit
from hypothesis import given
from hypothesis import strategies as st
from support import eventually, run

from fieldtwin.emulators.modbus.bank import CellSpan, MapBank
from fieldtwin.gateway.core.errors import ConnectionLost, EndpointBusy, FieldtwinError
from fieldtwin.gateway.devices.config import DeviceConfig
from fieldtwin.gateway.devices.register_device import RegisterDriver, SensorDriver
from fieldtwin.gateway.protocols.modbus.server.analysis import examine
from fieldtwin.gateway.protocols.modbus.server.forward import ForwardedReply
from fieldtwin.gateway.runtime.buses.modbus.bridge_queue import MAX_WAIT_NS, BridgeQueue, BridgeRequest
from fieldtwin.gateway.runtime.buses.modbus.jobs import BusJob
from fieldtwin.gateway.runtime.buses.modbus.modbus_bus import ModbusBus
from fieldtwin.gateway.runtime.tags import TagTable

READ = bytes.fromhex("03 0064 0001")
Result = ForwardedReply | FieldtwinError


def guest(
    client: str, results: list[Result], *, queued_ns: int = 0, wanted: Callable[[], bool] = lambda: True
) -> BridgeRequest:
    return BridgeRequest(client, 1, READ, examine(READ), 1, queued_ns, results.append, wanted)


def make(tags: TagTable) -> list[RegisterDriver]:
    """A device whose two groups are always overdue."""
    p = profile(
        "tags:\n  a: {at: 'holding:0', poll: a}\n  b: {at: 'holding:20', poll: b}\n"
        "  out: {at: 'holding:200', access: rw, poll: never}\n"
    )
    return [SensorDriver(DeviceConfig("d", p, "bus", 1, poll={"a": 1, "b": 1}), tags)]


def field() -> FieldBus:
    return FieldBus({1: unit(MapBank([CellSpan("holding", 0, 201)]))}, latency_s=0.003)


def flood(bus: ModbusBus, results: list[Result], clients: int, each: int) -> None:
    for _ in range(each):
        for number in range(clients):
            bus.guests.put(guest(f"c{number}", results, queued_ns=bus._clock.monotonic_ns()))


def test_clients_and_polls_that_are_due_take_turns() -> None:
    async def main() -> None:
        async with running_bus(make, field()) as r:
            await eventually(lambda: len(r.field.heard) > 4)
            results: list[Result] = []
            before = len(r.field.heard)
            flood(r.bus, results, 4, 5)
            await eventually(lambda: len(results) == 20)
            asked = [adu[2:4] == READ[1:3] for adu in r.field.heard[before:]]
            between = [i for i, guest in enumerate(asked) if guest]
            assert [b - a for a, b in pairwise(between)] == [2] * 19  # one poll between any two
            assert all(isinstance(result, ForwardedReply) for result in results)

    run(main())


def test_mb_063_a_write_of_the_plc_goes_before_clients_and_polls() -> None:
    async def main() -> None:
        async with running_bus(make, field()) as r:
            await eventually(lambda: len(r.field.heard) > 4)
            results: list[Result] = []
            flood(r.bus, results, 4, 10)
            await eventually(lambda: len(results) == 3)
            driver = r.bus.devices[0].driver
            ended: list[FieldtwinError | None] = []
            before = len(r.field.heard)
            driver.consumer.observe(driver.command("out", 7))
            r.bus.submit(BusJob(driver, driver.send, ended.append))
            await eventually(lambda: bool(ended))
            assert ended == [None]
            functions = [adu[1] for adu in r.field.heard[before:]]
            assert 0x10 in functions[:2]  # after the current one at most
            await eventually(lambda: len(results) == 40)

    run(main())


def test_clients_take_turns_among_themselves() -> None:
    queue = BridgeQueue()
    for client in ("a", "a", "a", "b", "c"):
        queue.put(guest(client, []))
    taken = [queue.take(0) for _ in range(5)]
    assert [g.client for g in taken if g is not None] == ["a", "b", "c", "a", "a"]
    assert queue.take(0) is None


def test_expired_and_abandoned_requests_are_never_sent() -> None:
    queue, results = BridgeQueue(), list[Result]()
    queue.put(guest("a", results, queued_ns=0))
    queue.put(guest("a", results, wanted=lambda: False))
    assert queue.take(MAX_WAIT_NS + 1) is None
    assert [type(r) for r in results] == [EndpointBusy]
    assert (queue.counters.stale, queue.counters.gone, queue.size) == (1, 1, 0)


def test_if_the_wire_does_not_return_all_clients_get_an_answer() -> None:
    async def main() -> None:
        async with running_bus(make, field()) as r:
            await eventually(lambda: len(r.field.heard) > 4)
            results: list[Result] = []
            flood(r.bus, results, 2, 3)
            r.field.unplug()
            await eventually(lambda: len(results) == 6)
            assert isinstance(results[-1], FieldtwinError)
            assert not any(isinstance(x, ConnectionLost) for x in results[1:])  # the rest waited for the reopening

    run(main())


@given(st.lists(st.tuples(st.sampled_from("abc"), st.booleans()), max_size=60), st.integers(1, 20))
def test_the_queue_never_holds_more_than_its_limit_and_answers_each_once(
    puts: list[tuple[str, bool]], limit: int
) -> None:
    queue = BridgeQueue(limit)
    answers: list[list[Result]] = []
    taken = 0
    for client, take in puts:
        answers.append([])
        queue.put(guest(client, answers[-1]))
        assert queue.size <= limit
        if take:
            taken += queue.take(0) is not None
    waiting = queue.size
    queue.fail_all(EndpointBusy("the end"))
    assert queue.size == 0
    assert all(len(a) <= 1 for a in answers)
    assert sum(len(a) for a in answers) + taken == len(puts)
    assert queue.counters.full + waiting + taken == len(puts)
