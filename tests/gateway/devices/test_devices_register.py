"""Register drivers against an emulated sampling sensor, and their codec against the emulators' codec and against `struct`."""

from __future__ import annotations

import math
import struct
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest
from gateway_rig import LINE, PROFILES, FieldBus, profile
from hypothesis import given
from hypothesis import strategies as st
from support import run

from fieldtwin.emulators import codec as emulated
from fieldtwin.emulators.modbus.bank import CellSpan, MapBank
from fieldtwin.emulators.modbus.unit import ModbusUnit
from fieldtwin.emulators.models.modbus.sampled_sensor import SampledSensor
from fieldtwin.emulators.signals import SignalPlayer, SignalTrack
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.concurrency.events import Consumer
from fieldtwin.gateway.core.errors import FileInvalid, UnknownCommand, VerifyFailed
from fieldtwin.gateway.core.files.profile_file import load_profile
from fieldtwin.gateway.core.files.recording import SignalRow
from fieldtwin.gateway.core.values import COMMAND, DATA, MEASUREMENT
from fieldtwin.gateway.devices.codec import decode, decode_little, encode, reorder
from fieldtwin.gateway.devices.config import DeviceConfig
from fieldtwin.gateway.devices.register_device import SensorDriver
from fieldtwin.gateway.protocols.modbus.client import ModbusClient
from fieldtwin.gateway.runtime.tags import TagTable
from fieldtwin.gateway.wallclock import WallClock

CTD = load_profile(PROFILES / "ctd-reference.yaml")
SAMPLED = ("pressure", "temperature", "conductivity", "instrument_time")


class Ctd:
    """A driver, its tags, and the emulated sensor on a line. `at` moves the sensor's own clock (seconds)."""

    def __init__(self, driver: SensorDriver, tags: TagTable, sensor: SampledSensor, start_ns: int) -> None:
        self.driver, self.tags, self.sensor, self._start_ns = driver, tags, sensor, start_ns
        self.messages: Consumer[DATA] = Consumer(driver.emitter.event)
        driver.emitter.subscribe(self.messages)

    def reason(self, tag: str) -> str:
        value = self.tags.current(f"ctd.{tag}", WallClock().monotonic_ns())
        return f"{value.quality} {value.reason}"

    async def poll(self) -> None:
        await self.driver.receive("status")
        await self.driver.receive("values")

    async def period(self, seconds: int) -> None:
        self.driver.consumer.observe(self.driver.command("sample_period_s", seconds))
        await self.driver.send()

    def sample(self, count: int) -> None:
        """The sensor took `count` samples in total, the last one now."""
        self.sensor.samples = count - 1
        self.sensor._sample(self._start_ns)


@asynccontextmanager
async def ctd(rows: list[SignalRow] | None = None) -> AsyncIterator[Ctd]:
    clock = WallClock()
    start_ns = clock.monotonic_ns()
    track = SignalTrack(("pressure", "temperature", "conductivity"), rows or [SignalRow(0.0, (5.0, 12.5, 3.25))])
    sensor = SampledSensor(CTD, SignalPlayer(track, start_ns), {"serial": "0042"})
    field = FieldBus({1: ModbusUnit(sensor)})
    connection = await field.open_bytes(LINE)
    client = ModbusClient(connection, clock, framing="rtu", serial=LINE.serial, timeout_s=0.3)
    tags = TagTable(clock)
    driver = SensorDriver(DeviceConfig("ctd", CTD, "line1", 1, expect={"serial": "0042"}), tags)
    tags.declare(driver.tag_names, 5000)
    driver.attach_client(connection, client)
    try:
        yield Ctd(driver, tags, sensor, start_ns)
    finally:
        await client.aclose()
        await field.aclose()


def test_a_sensor_that_answers_and_does_not_sample_has_no_good_values() -> None:
    async def main() -> None:
        async with ctd() as c:
            await c.poll()
            assert c.reason("sample_count") == "good none"
            assert {c.reason(t) for t in SAMPLED} <= {"bad never read", "bad not a number"}
            assert not c.messages.queue

    run(main())


def test_a_new_sample_is_good_and_passed_on_once_and_unaltered() -> None:
    async def main() -> None:
        async with ctd() as c:
            await c.poll()
            await c.period(60)  # takes a sample at once
            await c.poll()
            assert {c.reason(t) for t in SAMPLED} == {"good none"}
            now = c.tags.current("ctd.pressure", 0)
            assert now.value == 5.0
            for _ in range(3):
                await c.poll()
            assert c.tags.current("ctd.pressure", 0).t_ns == now.t_ns  # as old as the sample, not as the poll
            (message,) = c.messages.queue
            expected = struct.pack(">fffII", 5.0, 12.5, 3.25, 1, int.from_bytes(message.data[16:20]))
            assert message == MEASUREMENT(expected)
            c.sample(2)
            await c.poll()
            assert len(c.messages.queue) == 2
            assert c.tags.current("ctd.pressure", 0).t_ns > now.t_ns

    run(main())


def test_the_first_count_is_only_a_reference() -> None:
    """A driver that starts in the middle does not know the age of the sample that it finds."""

    async def main() -> None:
        async with ctd() as c:
            await c.period(60)
            c.driver._sample_count = None
            c.driver._sample_t_ns = 0
            await c.poll()
            assert {c.reason(t) for t in SAMPLED} == {"uncertain not sampling"}
            assert not c.messages.queue
            c.sample(2)
            await c.poll()
            assert {c.reason(t) for t in SAMPLED} == {"good none"}

    run(main())


def test_missed_samples_are_counted_and_a_restart_is_not_a_miss() -> None:
    async def main() -> None:
        async with ctd() as c:
            await c.period(60)
            await c.poll()
            c.sample(5)
            await c.poll()
            assert c.driver.samples_missed == 3
            c.sample(2)  # the counter went back: it restarted
            await c.poll()
            assert c.driver.samples_missed == 3
            assert c.reason("pressure") == "good none"
            c.sample(0xFFFFFFFF)
            await c.poll()
            missed = c.driver.samples_missed
            c.sample(1)  # the counter came round: 0 was missed, 1 is new
            await c.poll()
            assert c.driver.samples_missed == missed + 1
            assert len(c.messages.queue) == 4  # the first was the reference

    run(main())


def test_after_standby_the_last_sample_is_uncertain() -> None:
    async def main() -> None:
        async with ctd() as c:
            await c.poll()
            await c.period(60)
            await c.poll()
            for period in (0, -1):
                await c.period(period)
                await c.poll()
                assert {c.reason(t) for t in SAMPLED} == {"uncertain not sampling"}
                assert c.tags.current("ctd.pressure", 0).value == 5.0

    run(main())


def test_a_signal_without_a_value_is_bad_and_the_others_are_good() -> None:
    async def main() -> None:
        async with ctd([SignalRow(0.0, (5.0, math.nan, 3.25))]) as c:
            await c.poll()
            await c.period(60)
            await c.poll()
            assert c.reason("temperature") == "bad not a number"
            assert c.reason("pressure") == "good none"

    run(main())


def test_a_command_outside_the_list_is_refused_before_the_wire() -> None:
    async def main() -> None:
        async with ctd() as c:
            c.driver.consumer.observe(COMMAND(b"\0\1", "explode"))
            with pytest.raises(UnknownCommand, match="explode"):
                await c.driver.send()
            assert not c.driver.consumer.queue

    run(main())


def test_a_write_that_is_acknowledged_and_not_held_is_an_error() -> None:
    async def main() -> None:
        async with ctd() as c:
            c.sensor._note_tags = lambda *a: c.sensor._cells.poke("holding", 1, 9)  # type: ignore[method-assign]
            with pytest.raises(VerifyFailed, match="acknowledged the write, but holds a different value"):
                await c.period(5)
            assert c.tags.current("ctd.sample_period_s", 0).value == 9  # the published values are those it holds

    run(main())


# -- the sensor, a function of time -------------------------------------------------------------------------------------


def sensor_at(start_ns: int = 0) -> SampledSensor:
    rows = [SignalRow(float(t), (float(t), 2.0 * t, 3.0 * t)) for t in range(100)]
    track = SignalTrack(("pressure", "temperature", "conductivity"), rows)
    return SampledSensor(CTD, SignalPlayer(track, start_ns), {"serial": "0042"})


def read_sample(sensor: SampledSensor, now_ns: int) -> tuple[float, ...]:
    words = sensor.read("input", 0, 10, now_ns)
    return struct.unpack(">fffII", struct.pack(">10H", *words))


@given(period_s=st.integers(1, 20), set_at_s=st.floats(0, 10), looks=st.lists(st.floats(0, 80), min_size=1, max_size=8))
def test_samples_are_taken_on_time_independent_of_polls(period_s: int, set_at_s: float, looks: list[float]) -> None:
    sensor = sensor_at()
    set_ns = round(set_at_s * NS_PER_S)
    sensor.write("holding", 1, [period_s], set_ns)
    for look_s in sorted(looks):
        now_ns = set_ns + round(look_s * NS_PER_S)
        pressure, temperature, _, count, time_ms = read_sample(sensor, now_ns)
        taken = (now_ns - set_ns) // (period_s * NS_PER_S)
        assert count == taken + 1
        expected_s = set_at_s + taken * period_s
        assert time_ms == pytest.approx(1000 * expected_s, abs=1)
        assert pressure == pytest.approx(time_ms / 1000, rel=1e-6)  # all of one instant, which is next to them
        assert temperature == pytest.approx(2 * time_ms / 1000, rel=1e-6)


@pytest.mark.parametrize(("period", "status"), [(5, 1), (0, 0), (-1, 2), (-32768, 2), (32767, 1)])
def test_the_status_follows_the_sign_of_the_period(period: int, status: int) -> None:
    sensor = sensor_at()
    sensor.write("holding", 1, [period & 0xFFFF], 0)
    assert list(sensor.read("holding", 0, 2, 0)) == [status, period & 0xFFFF]
    count = read_sample(sensor, 200_000 * NS_PER_S)[3]
    assert (count > 0) == (period > 0)


def test_after_a_year_without_polls_it_still_answers() -> None:
    sensor = sensor_at()
    sensor.write("holding", 1, [1], 0)
    year_s = 365 * 86400
    assert read_sample(sensor, year_s * NS_PER_S)[3] == year_s + 1


def test_a_recording_without_a_signal_of_the_device_is_refused() -> None:
    track = SignalTrack(("pressure", "temperature"), [SignalRow(0.0, (1.0, 2.0))])
    with pytest.raises(FileInvalid, match="no such signal"):
        SampledSensor(CTD, SignalPlayer(track, 0), {})


# -- two independent codecs ---------------------------------------------------------------------------------------------

CODES = {
    "int16": "h", "uint16": "H", "int32": "i", "uint32": "I", "int64": "q", "uint64": "Q", "float32": "f", "float64": "d",
}  # fmt: skip
ORDERS = ["ABCD", "CDAB", "BADC", "DCBA"]


@given(kind=st.sampled_from(sorted(CODES)), order=st.sampled_from(ORDERS), data=st.data())
def test_the_drivers_codec_and_the_emulators_agree(kind: str, order: str, data: st.DataObject) -> None:
    size = struct.calcsize(">" + CODES[kind])
    raw = data.draw(st.binary(min_size=size, max_size=size))
    (number,) = struct.unpack(">" + CODES[kind], raw)
    tag = profile(f'tags:\n  x: {{at: "holding:0", type: {kind}, order: {order}, access: rw}}\n').tags["x"]
    if not math.isfinite(number):
        words = emulated.encode(number, kind, order)
        assert decode(tag, b"".join(w.to_bytes(2) for w in words), 0).value is None
        return
    wire = b"".join(w.to_bytes(2) for w in emulated.encode(number, kind, order))
    read = decode(tag, wire, 0)
    assert read.value == number
    assert read.raw == wire
    written = encode(tag, number)
    assert written == wire
    assert emulated.decode([int.from_bytes(written[i : i + 2]) for i in range(0, size, 2)], kind, order) == number
    little = decode_little(profile(f'tags:\n  x: {{at: "holding:0", type: {kind}}}\n').tags["x"], raw[::-1], 0)
    assert little.value == number  # CANopen: least significant byte first


@given(st.binary(max_size=16).filter(lambda b: len(b) % 2 == 0), st.sampled_from(ORDERS))
def test_every_order_is_its_own_inverse(data: bytes, order: str) -> None:
    assert reorder(reorder(data, order), order) == data


@given(st.text(st.characters(min_codepoint=33, max_codepoint=126), max_size=12), st.sampled_from(ORDERS))
def test_text_ends_at_its_first_nul_whatever_the_order_of_bytes(text: str, order: str) -> None:
    tag = profile(f'tags:\n  x: {{at: "holding:0", type: string, registers: 6, order: {order}}}\n').tags["x"]
    wire = b"".join(w.to_bytes(2) for w in emulated.encode(text, "string", order, registers=6))
    assert decode(tag, wire, 0).value == text


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize(("kind", "digits"), [("bcd16", 4), ("bcd32", 8)])
@given(data=st.data())
def test_binary_coded_decimals_are_the_digits_that_one_reads(
    kind: str, digits: int, order: str, data: st.DataObject
) -> None:
    number = data.draw(st.integers(0, 10**digits - 1))
    tag = profile(f'tags:\n  x: {{at: "holding:0", type: {kind}, order: {order}, access: rw}}\n').tags["x"]
    words = emulated.encode(number, kind, order)
    wire = b"".join(w.to_bytes(2) for w in words)
    if order == "ABCD":
        assert wire.hex() == f"{number:0{digits}d}"
    assert decode(tag, wire, 0).value == number
    assert encode(tag, number) == wire
    assert emulated.decode(words, kind, order) == number
    assert decode(tag, emulated.encode(math.nan, kind)[0].to_bytes(2) * (digits // 4), 0).value is None
    assert emulated.encode(10.0**digits, kind) == emulated.encode(10**digits - 1, kind)  # as much as it can show


def test_a_coil_is_written_with_0fh_if_the_device_has_no_05() -> None:
    async def main(functions: str, expected: int) -> None:
        p = profile(f'limits: {{functions: {functions}}}\ntags:\n  c: {{at: "coil:3", type: bool, access: rw}}\n')
        bank = MapBank([CellSpan("coil", 0, 8)])
        field = FieldBus({1: ModbusUnit(bank)})
        connection = await field.open_bytes(LINE)
        client = ModbusClient(connection, WallClock(), framing="rtu", serial=LINE.serial, timeout_s=0.3)
        driver = SensorDriver(DeviceConfig("d", p, "line1", 1), TagTable(WallClock()))
        driver.attach_client(connection, client)
        try:
            driver.consumer.observe(driver.command("c", 1))
            await driver.send()
        finally:
            await client.aclose()
            await field.aclose()
        assert bank.peek("coil", 3) == 1
        assert expected in [adu[1] for adu in field.heard]

    run(main("[1, 15]", 15))
    run(main("[1, 5, 15]", 5))
