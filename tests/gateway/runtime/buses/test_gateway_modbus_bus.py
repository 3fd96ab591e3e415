"""One Modbus bus: order of requests, units in back-off, and the effect of a lost connection or a refusal on tags."""

from __future__ import annotations

import asyncio
from itertools import pairwise

import pytest
from gateway_rig import LAN, LINE, FieldBus, profile, running_bus, unit
from hypothesis import given
from hypothesis import strategies as st
from support import eventually, run
from two_poll_groups import TWO_GROUPS, bank, config

from fieldtwin.emulators.modbus.bank import CellSpan, DeviceFailure, MapBank, Table
from fieldtwin.gateway.core.errors import ConnectionLost, EndpointBusy, FieldtwinError, Unreachable
from fieldtwin.gateway.devices.config import DeviceConfig
from fieldtwin.gateway.devices.register_device import RegisterDriver, SensorDriver
from fieldtwin.gateway.runtime.buses.backoff import Backoff
from fieldtwin.gateway.runtime.buses.modbus.jobs import MAX_JOBS, BusJob
from fieldtwin.gateway.runtime.tags import TagTable


def test_a_dead_unit_costs_the_others_nothing_and_is_still_asked() -> None:
    """MB-062. Unit 2 does not exist; unit 1's values never become stale, and unit 2 is asked once at a time."""

    async def main() -> None:
        p = profile(TWO_GROUPS)
        living = unit(bank())

        def make(tags: TagTable) -> list[RegisterDriver]:
            return [
                SensorDriver(config("alive", p, 1), tags),
                SensorDriver(config("dead", p, 2, expect={"name": "abc"}), tags),
            ]

        async with running_bus(make, FieldBus({1: living}), timeout_s=0.06) as r:
            await eventually(lambda: r.quality("alive.fast") == ("good", "none"))
            start = asyncio.get_running_loop().time()
            bad: list[tuple[str, str]] = []

            def passed() -> bool:
                if (now := r.quality("alive.fast")) != ("good", "none"):
                    bad.append(now)
                return asyncio.get_running_loop().time() - start > 1.5

            await eventually(passed)
            assert bad == []
            dead = [adu for adu in r.field.heard if adu[0] == 2]
            alive = [adu for adu in r.field.heard if adu[0] == 1]
            assert r.quality("dead.fast") == ("bad", "timeout")
            timeouts = r.bus.totals()["timeouts"]
            assert 1 <= timeouts <= 1.5 / 0.12 + 1  # not again before its timeout is over, and as much again
            assert timeouts <= len(dead) <= timeouts + 1
            assert len(alive) > 25
            assert len(dead) <= r.bus.devices[1].polls <= len(dead) + 1

    run(main())


def test_a_write_goes_before_every_due_poll() -> None:
    """MB-063. Ten groups are overdue; the newest submitted job is next."""

    async def main() -> None:
        lines = "".join(f"  t{i}: {{at: 'holding:{20 * i}', poll: g{i}}}\n" for i in range(10))
        p = profile("tags:\n" + lines + "  out: {at: 'holding:500', access: rw, poll: never}\n")
        cells = MapBank([CellSpan("holding", 0, 501)])
        poll = {f"g{i}": 1 for i in range(10)}

        def make(tags: TagTable) -> list[RegisterDriver]:
            return [SensorDriver(DeviceConfig("d", p, "bus", 1, poll=poll), tags)]

        async with running_bus(make, FieldBus({1: unit(cells)}, latency_s=0.01)) as r:
            await eventually(lambda: len(r.field.heard) > 12)
            driver = r.bus.devices[0].driver
            ended: list[FieldtwinError | None] = []
            before = len(r.field.heard)
            driver.consumer.observe(driver.command("out", 7))
            r.bus.submit(BusJob(driver, driver.send, ended.append))
            await eventually(lambda: bool(ended))
            assert ended == [None]
            functions = [adu[1] for adu in r.field.heard[before:]]
            assert 0x10 in functions[:2]  # after the current one at most
            assert cells.peek("holding", 500) == 7

    run(main())


def test_a_lost_connection_is_reopened_with_growing_pauses_and_the_values_show_it() -> None:
    async def main() -> None:
        p = profile(TWO_GROUPS)

        def make(tags: TagTable) -> list[RegisterDriver]:
            return [RegisterDriver(config("d", p, 1), tags)]

        async with running_bus(make, FieldBus({1: unit(bank())}), LAN) as r:
            await eventually(lambda: r.quality("d.fast") == ("good", "none"))
            requests = r.bus.totals()["requests"]
            r.field.unplug()
            await eventually(lambda: not r.bus.connected)
            assert r.quality("d.fast") == ("bad", "unreachable")
            assert r.lost == [r.bus.devices[0].driver]
            refused: list[FieldtwinError | None] = []
            driver = r.bus.devices[0].driver
            r.bus.submit(BusJob(driver, driver.send, refused.append))  # no connection: it fails at once
            assert isinstance(refused[0], Unreachable)
            await eventually(lambda: len(r.field.tries) >= 4)
            tries = r.field.tries
            pauses = [b - a for a, b in pairwise(tries[1:])]
            assert pauses[1] > 1.5 * pauses[0] > 0.3
            r.field.plugged = True
            await eventually(lambda: r.quality("d.fast") == ("good", "none"))
            assert r.bus.opens == 2
            assert r.bus.totals()["requests"] > requests  # counted over both connections

    run(main())


def test_a_job_that_waits_when_the_connection_is_lost_gets_an_error() -> None:
    async def main() -> None:
        p = profile(TWO_GROUPS)

        def make(tags: TagTable) -> list[RegisterDriver]:
            return [RegisterDriver(config("d", p, 1), tags)]

        async with running_bus(make, FieldBus({1: unit(bank())}, latency_s=0.05), LAN) as r:
            await eventually(lambda: r.bus.connected)
            driver = r.bus.devices[0].driver
            ended: list[FieldtwinError | None] = []
            for _ in range(MAX_JOBS + 5):
                r.bus.submit(BusJob(driver, driver.send, ended.append))
            assert len(ended) == 5  # there is a bound, and a caller beyond it gets an error
            assert all(isinstance(e, EndpointBusy) for e in ended)
            driver.consumer.observe(driver.command("slow", 1))
            r.field.unplug()
            await eventually(lambda: len(ended) == MAX_JOBS + 5)
            assert all(isinstance(e, ConnectionLost) for e in ended[5:])
            assert len(driver.consumer.queue) == 1  # the unsent one is still first in the queue

    run(main())


class Refusing(MapBank):
    """A device whose slow group fails."""

    def read(self, table: Table, address: int, count: int, now_ns: int) -> list[int]:
        if address == 10:
            raise DeviceFailure("broken")
        return list(super().read(table, address, count, now_ns))


def test_a_refused_group_is_bad_and_the_others_continue() -> None:
    async def main() -> None:
        p = profile(TWO_GROUPS)
        refusing = Refusing([CellSpan("holding", 0, 1), CellSpan("holding", 10, 1)])

        def make(tags: TagTable) -> list[RegisterDriver]:
            return [SensorDriver(config("d", p, 1), tags)]

        async with running_bus(make, FieldBus({1: unit(refusing)})) as r:
            await eventually(lambda: r.quality("d.slow") == ("bad", "refused"))
            await eventually(lambda: r.quality("d.fast") == ("good", "none"))
            assert r.bus.online(r.bus.devices[0].driver)
            assert r.bus.totals()["exceptions"] >= 1

    run(main())


def test_a_group_without_a_period_is_read_once_after_connecting() -> None:
    async def main() -> None:
        p = profile(TWO_GROUPS)

        def make(tags: TagTable) -> list[RegisterDriver]:
            return [SensorDriver(config("d", p, 1), tags)]

        async with running_bus(make, FieldBus({1: unit(bank())})) as r:
            await eventually(lambda: r.bus.devices[0].polls > 10)
            assert r.tags.current("d.name", 0).value == "abc"
            identity = [adu for adu in r.field.heard if adu[2:4] == bytes([0, 20])]
            assert len(identity) == 1

    run(main())


def test_the_wrong_device_has_no_values_and_is_asked_again() -> None:
    async def main() -> None:
        p = profile(TWO_GROUPS)
        cells = bank()

        def make(tags: TagTable) -> list[RegisterDriver]:
            return [SensorDriver(config("d", p, 1, expect={"name": "xyz"}), tags)]

        async with running_bus(make, FieldBus({1: unit(cells)})) as r:
            await eventually(lambda: r.quality("d.fast") == ("bad", "wrong device"))
            driver = r.bus.devices[0].driver
            assert driver.identity_error == "name is 'abc'"
            assert not r.bus.online(driver)
            cells.poke("holding", 20, 0x7879, 0x7A00)  # the correct one is used there
            await eventually(lambda: r.quality("d.fast") == ("good", "none"))
            assert driver.identity_error == ""

    run(main())


def test_nothing_is_sent_after_halt() -> None:
    async def main() -> None:
        p = profile(TWO_GROUPS)

        def make(tags: TagTable) -> list[RegisterDriver]:
            return [SensorDriver(config("d", p, 1, every_ms=5), tags)]

        async with running_bus(make, FieldBus({1: unit(bank())}, latency_s=0.01), LINE) as r:
            await eventually(lambda: len(r.field.heard) > 5)
            await r.bus.halt(1.0)
            sent = len(r.field.heard)
            totals = r.bus.totals()
            assert totals["requests"] == totals["replies"]
            done = asyncio.get_running_loop().create_future()
            asyncio.get_running_loop().call_later(0.1, done.set_result, None)
            await done
            assert len(r.field.heard) == sent

    run(main())


@given(first=st.floats(0.01, 5), limit=st.floats(5, 60), failures=st.integers(1, 2000))
def test_back_off_doubles_up_to_its_limit_and_starts_again(first: float, limit: float, failures: int) -> None:
    backoff = Backoff(first, limit)
    delays = [backoff.next_s() for _ in range(failures)]
    assert delays[0] == first
    assert all(b == pytest.approx(min(2 * a, limit)) for a, b in pairwise(delays))
    backoff.reset()
    assert backoff.next_s() == first
