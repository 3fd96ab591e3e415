"""Timing of a Modbus bus in virtual time: dead units, pauses, periods and phases, and priorities."""

from __future__ import annotations

import asyncio
from itertools import pairwise

import pytest
from gateway_rig import profile
from hypothesis import given
from hypothesis import strategies as st
from modbus_virtual import run_virtually
from virtual_bus import LINE, VirtualBus, run_bus

from fieldtwin.emulators.modbus.bank import CellSpan, MapBank
from fieldtwin.emulators.modbus.unit import ModbusUnit
from fieldtwin.gateway.core.clock import NS_PER_MS, NS_PER_S
from fieldtwin.gateway.core.errors import FieldtwinError, Unreachable, UsageError
from fieldtwin.gateway.core.values import Reason
from fieldtwin.gateway.devices.config import BusConfig, DeviceConfig
from fieldtwin.gateway.devices.register_device import RegisterDriver, SensorDriver
from fieldtwin.gateway.protocols.modbus.unit_timing import UnitPace
from fieldtwin.gateway.runtime.buses.modbus.jobs import BusJob
from fieldtwin.gateway.runtime.buses.poll_schedule import PollSchedule, PollSlot, spread
from fieldtwin.gateway.runtime.tags import TagTable

ONE = profile('tags:\n  level: {at: "holding:0"}\n')
IDENTIFIED = profile('tags:\n  level: {at: "holding:0"}\n  name: {at: "holding:50", poll: identity}\n')
FAR_APART = profile(
    "limits: {max_gap: 0}\ntags:\n"
    + "".join(f'  t{i}: {{at: "holding:{20 * i}"}}\n' for i in range(4))
    + '  out: {at: "holding:99", access: rw, poll: never}\n'
)


def unit() -> ModbusUnit:
    return ModbusUnit(MapBank([CellSpan("holding", 0, 100)]))


def one(address: int, tags: TagTable, every_ms: int = 100, p=ONE, **more: object) -> SensorDriver:  # type: ignore[no-untyped-def]
    config = DeviceConfig(f"d{address}", p, "line", address, poll={"values": every_ms}, **more)  # type: ignore[arg-type]
    return SensorDriver(config, tags)


async def wait(seconds: float) -> None:
    await asyncio.sleep(seconds)


def observed(
    there: list[int], configured: list[int], seconds: float, config: BusConfig, every_ms: int = 100, **more: object
) -> VirtualBus:
    """A bus whose devices are all polled at one period, after `seconds`."""

    async def main() -> VirtualBus:
        def make(tags: TagTable) -> list[RegisterDriver]:
            return [one(a, tags, every_ms, **more) for a in configured]

        return await run_bus(make, {a: unit() for a in there}, lambda _: wait(seconds), config=config)

    return run_virtually(main())


@pytest.mark.parametrize(("dead", "share"), [([4], 0.1), ([1], 0.1), ([4, 5, 6, 7], 0.1), ([4, 5], 0.02)])
def test_mb_062_dead_units_cost_the_others_no_more_than_the_share_of_their_probes(
    dead: list[int], share: float
) -> None:
    """Units that answer lose no more polls than the share of the bus that probes may use, whatever the number of silent units."""
    living = [a for a in range(1, 5) if a not in dead][:3]
    config = BusConfig("line", LINE, 0.5, 1, probe_share=share)
    end_s, rate = 240.0, 5
    alone = observed(living, living, end_s, config, every_ms=1000 // rate)
    beside = observed(living, sorted({*living, *dead}), end_s, config, every_ms=1000 // rate)
    settled_s = 5.0
    for address in living:
        without, with_dead = len(alone.line.times(address, settled_s)), len(beside.line.times(address, settled_s))
        assert without == pytest.approx((end_s - settled_s) * rate, abs=2)
        assert with_dead >= (1 - share) * without - 1.2 * rate  # a probe may just have ended
    probes = sorted(t for a in dead for t in beside.line.times(a, settled_s))
    assert len(probes) >= 0.8 * share * (end_s - settled_s) - 2  # they are probed again: the share is used
    shortened_s = 0.05 + 0.013  # the timeout while the latency seen is 5 ms, and what the request itself takes
    assert len(probes) * shortened_s <= share * (end_s - settled_s) + 3.0 + len(dead) * shortened_s
    assert {d.driver.config.address for d in beside.bus.devices if d.online} == set(living)


def test_mb_062_an_intermittent_unit_has_no_larger_share() -> None:
    """It answers the identification and then nothing more, each time it seems to be back."""

    async def main() -> VirtualBus:
        def make(tags: TagTable) -> list[RegisterDriver]:
            return [one(1, tags), one(2, tags, p=IDENTIFIED, expect={"name": "0"})]

        async def scenario(v: VirtualBus) -> None:
            v.line.silent = lambda frame: frame[0] == 2 and frame[3] == 0
            await wait(120)

        config = BusConfig("line", LINE, 0.5, 1)
        return await run_bus(make, {1: unit(), 2: unit()}, scenario, config=config)

    v = run_virtually(main())
    assert len(v.line.times(2)) > 2
    assert len(v.line.times(1, 10)) >= 0.95 * 1100 - 25


def test_a_dead_unit_that_is_plugged_in_is_back_within_its_back_off() -> None:
    async def main() -> None:
        def make(tags: TagTable) -> list[RegisterDriver]:
            return [one(1, tags, backoff_first_s=0.5, backoff_limit_s=4.0)]

        async def scenario(v: VirtualBus) -> None:
            await wait(60)
            assert v.tags.current("d1.level", 0).reason is Reason.TIMEOUT
            tries = v.line.times(1)
            pauses = [b - a for a, b in pairwise(tries[1:])]
            assert pauses[0] == pytest.approx(0.7, abs=0.1)  # a timeout, and the pause after it
            assert max(pauses) == pytest.approx(4.2, abs=0.1)  # alone on its bus it delays no other unit
            v.line.units[1] = unit()
            await wait(4.3)
            assert v.bus.devices[0].online
            assert v.tags.current("d1.level", asyncio.get_running_loop().monotonic_ns()).good  # type: ignore[attr-defined]

        await run_bus(make, {}, scenario, config=BusConfig("line", LINE, 0.2, 1))

    run_virtually(main())


def test_a_unit_has_its_own_timeout_and_retries() -> None:
    """This applies after a unit answered once. Before that, if other units wait for the line, its timeouts are shortened."""

    async def main() -> None:
        def make(tags: TagTable) -> list[RegisterDriver]:
            return [
                one(2, tags, 5000, timeout_s=0.05, retries=3),
                one(3, tags, 5000),
                one(1, tags, 5000, timeout_s=2.0),
            ]

        async def scenario(v: VirtualBus) -> None:
            v.line.slow[1] = 1.5
            await wait(12)
            assert v.bus.devices[2].online  # slower than the bus allows, as it may be
            assert v.bus.devices[0].online
            assert not v.bus.devices[1].online
            del v.line.units[2]
            await wait(5)
            while v.bus.devices[0].online:
                await wait(0.1)
            assert len(v.line.times(2, 12)) == 4  # its own retries: three
            asked = len(v.line.times(1))
            v.line.units.pop(1)
            while v.bus.devices[2].online:
                await wait(0.1)
            assert len(v.line.times(1)) == asked + 1  # the bus's retries: none

        await run_bus(make, {1: unit(), 2: unit()}, scenario, config=BusConfig("line", LINE, 0.3, 0))

    run_virtually(main())


def test_while_a_unit_has_its_pause_others_use_the_line() -> None:
    """Unit 1 needs 80 ms between two requests; a group of it takes four. Unit 2 is still read every 20 ms."""

    async def main() -> None:
        def make(tags: TagTable) -> list[RegisterDriver]:
            return [one(1, tags, 1000, p=FAR_APART, spacing_s=0.08), one(2, tags, 20)]

        async def scenario(v: VirtualBus) -> None:
            await wait(20)
            answered = 0.016  # request, latency, reply and t3.5 of a transaction, roughly
            asked = v.line.times(1, 2)
            assert len(asked) == pytest.approx(4 * 18, abs=4)
            assert min(b - a for a, b in pairwise(asked)) >= 0.08 + 0.0127
            others = v.line.times(2, 2)
            assert max(b - a for a, b in pairwise(others)) < 0.02 + 2 * answered
            assert len(others) > 0.9 * 18 / 0.02
            assert v.bus.totals()["timeouts"] == 0

        await run_bus(make, {1: unit(), 2: unit()}, scenario)

    run_virtually(main())


def test_a_pause_of_the_bus_follows_every_exchange_and_every_connection() -> None:
    config = BusConfig("line", LINE, 0.2, 1, spacing_s=0.05, connect_pause_s=0.7)
    v = observed([1, 2], [1, 2], 10, config, every_ms=10)
    asked = [h.t_s for h in v.line.heard]
    assert asked[0] == pytest.approx(0.7, abs=0.001)
    assert min(b - a for a, b in pairwise(asked)) >= 0.05 + 0.012
    assert max(b - a for a, b in pairwise(asked)) < 0.05 + 0.016


def test_a_write_goes_between_two_transactions_of_one_group() -> None:
    """MB-063. It waits for one transaction, not for a group."""

    async def main() -> None:
        def make(tags: TagTable) -> list[RegisterDriver]:
            return [one(1, tags, 10, p=FAR_APART)]

        async def scenario(v: VirtualBus) -> None:
            await wait(1)
            driver = v.bus.devices[0].driver
            ended: list[FieldtwinError | None] = []
            before = len(v.line.heard)
            driver.consumer.observe(driver.command("out", 7))
            v.bus.submit(BusJob(driver, driver.send, ended.append))
            await wait(0.5)
            assert ended == [None]
            functions = [h.pdu[0] for h in v.line.heard[before:]]
            assert 0x10 in functions[:2]

        await run_bus(make, {1: unit()}, scenario)

    run_virtually(main())


def test_a_write_to_a_unit_in_its_pause_lets_one_to_another_unit_go_first() -> None:
    async def main() -> None:
        def make(tags: TagTable) -> list[RegisterDriver]:
            return [one(a, tags, 5000, p=FAR_APART, spacing_s=s) for a, s in ((1, 0.5), (2, 0.0))]

        async def scenario(v: VirtualBus) -> None:
            await wait(4.0)
            ended: list[tuple[int, int]] = []
            slow, quick = (d.driver for d in v.bus.devices)
            for n, driver in enumerate((slow, slow, quick)):
                driver.consumer.observe(driver.command("out", n))
                v.bus.submit(BusJob(driver, driver.send, lambda e, n=n: ended.append((n, bool(e)))))  # type: ignore[misc]
            await wait(4.0)
            assert ended == [(0, False), (2, False), (1, False)]  # and those of one unit stay in order
            writes = v.line.times(1, 4.0, 99)
            assert len(writes) == 4  # each is read back
            pauses = [b - a for a, b in pairwise(writes)]
            assert min(pauses) > 0.5

        await run_bus(make, {1: unit(), 2: unit()}, scenario)

    run_virtually(main())


def test_a_write_to_a_disconnected_unit_takes_no_time_of_the_line() -> None:
    async def main() -> None:
        def make(tags: TagTable) -> list[RegisterDriver]:
            return [one(1, tags), one(2, tags, p=FAR_APART)]

        async def scenario(v: VirtualBus) -> None:
            await wait(3)
            asked = len(v.line.times(2))
            driver = v.bus.devices[1].driver
            ended: list[FieldtwinError | None] = []
            driver.consumer.observe(driver.command("out", 7))
            v.bus.submit(BusJob(driver, driver.send, ended.append))
            await wait(0.1)
            assert isinstance(ended[0], Unreachable)
            assert len(v.line.times(2)) == asked

        await run_bus(make, {1: unit()}, scenario)

    run_virtually(main())


def test_groups_of_one_period_have_separate_places_in_it() -> None:
    """On the line: eight units, 400 ms; one states its phase."""

    async def main() -> None:
        def make(tags: TagTable) -> list[RegisterDriver]:
            return [one(a, tags, 400, phase={"values": 390} if a == 3 else {}) for a in range(1, 6)]

        async def scenario(v: VirtualBus) -> None:
            await wait(20.2)
            for address, phase_s in ((1, 0.0), (2, 0.1), (3, 0.39), (4, 0.2), (5, 0.3)):
                times = v.line.times(address, 1.0)
                assert len(times) == 48
                for t in times:
                    assert t % 0.4 == pytest.approx(phase_s, abs=0.011)  # unit 1 waits for unit 3's reply
            assert all(not d.schedule.missed["values"] for d in v.bus.devices)

        await run_bus(make, {a: unit() for a in range(1, 6)}, scenario)

    run_virtually(main())


def test_a_missed_period_is_skipped_and_counted_and_never_made_up_for() -> None:
    async def main() -> None:
        def make(tags: TagTable) -> list[RegisterDriver]:
            return [one(1, tags, 100), one(2, tags, 10_000, timeout_s=2.0)]

        async def scenario(v: VirtualBus) -> None:
            v.line.slow[2] = 0.95
            await wait(9)
            missed = v.bus.devices[0].schedule.missed["values"]
            await wait(20)  # unit 2 has the line at 10 and 20 s, each for 0.97 s
            times = v.line.times(1, 9)
            gaps = [b - a for a, b in pairwise(times)]
            assert [round(g, 1) for g in gaps if g > 0.15] == [1.0] * 2
            assert min(gaps[1:]) > 0.02  # no burst: at once after the gap, and then on the grid again
            assert all(t % 0.1 < 0.03 or t % 0.1 > 0.099 for t in times if not 0 < t % 10 < 1.1)
            # the one that was late each time is not among them
            assert v.bus.devices[0].schedule.missed["values"] - missed == 16

        await run_bus(make, {1: unit(), 2: unit()}, scenario)

    run_virtually(main())


# -- the schedule by itself ---------------------------------------------------------------------------------------


@given(
    periods=st.lists(st.sampled_from([100, 250, 1000]), min_size=1, max_size=12),
    offset=st.floats(0, 1, exclude_max=True),
)
def test_phases_are_spread_evenly_in_order_and_within_the_period(periods: list[int], offset: float) -> None:
    rates = spread(list(enumerate(periods)), offset=offset)
    for period in set(periods):
        phases = [rates[i].phase_ns for i, p in enumerate(periods) if p == period]
        assert all(0 <= phase < period * NS_PER_MS for phase in phases)
        steps = {b - a for a, b in pairwise(phases)}
        assert all(abs(step - period * NS_PER_MS / len(phases)) <= 1 for step in steps)
    assert spread(list(enumerate(periods)), offset=offset) == rates


@given(
    period_ms=st.integers(1, 50),
    phase_ms=st.integers(0, 49),
    steps=st.lists(st.integers(0, 400 * NS_PER_MS), min_size=1, max_size=30),
)
def test_every_period_is_read_or_counted_as_missed(period_ms: int, phase_ms: int, steps: list[int]) -> None:
    period_ns, phase_ns = period_ms * NS_PER_MS, (phase_ms % period_ms) * NS_PER_MS
    schedule = PollSchedule({"g": PollSlot(period_ns, phase_ns)}, [])
    start_ns = 3 * NS_PER_S
    schedule.anchor(start_ns)
    now_ns = start_ns + 7
    schedule.start(now_ns)
    schedule.took("g", now_ns)
    first_ns, taken = schedule.due_ns["g"], 0
    assert now_ns < first_ns <= now_ns + period_ns
    for step in steps:
        now_ns += step
        due_ns = schedule.due_ns["g"]
        assert (due_ns - start_ns - phase_ns) % period_ns == 0
        if due_ns <= now_ns:
            schedule.took("g", now_ns)
            taken += 1
            assert now_ns < schedule.due_ns["g"] <= now_ns + period_ns
    assert taken + schedule.missed["g"] == (schedule.due_ns["g"] - first_ns) // period_ns


def test_a_pace_out_of_range_is_refused() -> None:
    for wrong in ({"timeout_s": 0.0}, {"timeout_s": 4000.0}, {"spacing_s": -1.0}, {"spacing_s": float("nan")}):
        with pytest.raises(UsageError):
            UnitPace(**wrong)
