"""`scan` of hosts in virtual time: units behind a gateway, one device that answers as any unit, and hosts that disconnect."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from commissioning_rig import bank, loop, run_virtually, unit
from hypothesis import given, settings
from hypothesis import strategies as st
from modbus_virtual import VirtualWire

from fieldtwin.commissioning.scan.modbus import ModbusScan, ModbusScanner, ScanOptions
from fieldtwin.commissioning.scan.settings import TCP_UNITS
from fieldtwin.commissioning.scan.shared_unit_ids import SPREAD, detect_shared_unit_ids, spread_over
from fieldtwin.commissioning.scan.sweep import SendRequest, UnitAnswer, UnitSweep
from fieldtwin.emulators.modbus.bank import CellSpan
from fieldtwin.emulators.modbus.rtu.receiver import with_crc
from fieldtwin.gateway.core.connection import ByteConnection, CanConnection
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import ConnectionLost

Reply = Callable[[int], bytes | None]
"""Map a unit to the PDU of its answer; None: silence; b"": it disconnects."""


class Host:
    """A connector to a host; `rtu` frames or MBAP."""

    def __init__(self, reply: Reply, rtu: bool = False) -> None:
        self.reply, self.rtu = reply, rtu
        self.asked: list[int] = []
        self.opened = 0

    async def open_bytes(self, endpoint: Endpoint) -> ByteConnection:
        self.opened += 1

        def answer(data: bytes) -> None:
            number = data[0] if self.rtu else data[6]
            self.asked.append(number)
            pdu = self.reply(number)
            if pdu == b"":
                wire.feed_lost(ConnectionLost("hung up", where=str(endpoint)))
            elif pdu is not None:
                body = bytes([number]) + pdu
                frame = with_crc(body) if self.rtu else data[:4] + len(body).to_bytes(2, "big") + body
                asyncio.get_running_loop().call_later(0.005, wire.feed, frame)

        wire = VirtualWire(endpoint, answer)
        return wire

    async def open_can(self, endpoint: Endpoint, bitrate: int) -> CanConnection:
        raise AssertionError


async def scan(host: Host, url: str = "tcp://192.0.2.1:502", **options: object) -> ModbusScan:
    made = ScanOptions(**options)  # type: ignore[arg-type]
    return await ModbusScanner(url, made, connector=host, clock=loop()).run()


def value(number: int) -> bytes:
    return bytes([3, 2, 0, number])


def test_units_of_a_gateway_are_distinguished_from_missing_ones() -> None:
    async def main() -> None:
        host = Host(lambda u: value(u) if u in (3, 7) else b"\x83\x02" if u == 9 else b"\x83\x0b")
        found = await scan(host)
        assert [(f.answer.unit, f.answer.exception) for f in found.units] == [(3, 0), (7, 0), (9, 2)]
        assert len(found.behind_gateway) == len(TCP_UNITS) - 3
        assert sorted(host.asked) == sorted([*TCP_UNITS, 3, *([7] if host.asked.count(7) == 2 else []),
                                             *([9] if host.asked.count(9) == 2 else [])])  # fmt: skip
        assert found.alike is None

    run_virtually(main())


def test_a_device_that_answers_as_any_unit_is_one_and_the_rest_is_not_asked() -> None:
    async def main() -> None:
        for reply in (value(1), b"\x83\x02"):
            host = Host(lambda u, reply=reply: reply)  # type: ignore[misc]
            found = await scan(host)
            assert found.alike is not None
            assert found.alike.one_device
            assert found.asked == SPREAD

    run_virtually(main())


def test_one_device_whose_register_changes_is_possible_and_not_sure() -> None:
    async def main() -> None:
        ticks = iter(range(10_000))
        found = await scan(Host(lambda u: bytes([3, 2]) + next(ticks).to_bytes(2, "big")))
        assert found.alike is not None
        assert not found.alike.one_device
        assert len(found.units) == len(TCP_UNITS)

    run_virtually(main())


def test_many_real_units_stay_many() -> None:
    async def main() -> None:
        found = await scan(Host(value))
        assert found.alike is None
        assert len(found.units) == len(TCP_UNITS)

    run_virtually(main())


def test_four_new_meters_that_read_zero_are_not_called_one() -> None:
    async def main() -> None:
        found = await scan(Host(lambda u: value(0)), units=(1, 2, 3, 4))
        assert [f.answer.unit for f in found.units] == [1, 2, 3, 4]
        assert found.alike is None or not found.alike.one_device

    run_virtually(main())


def test_a_unit_at_which_the_host_disconnects_is_reported_and_the_others_are_asked() -> None:
    async def main() -> None:
        host = Host(lambda u: b"" if u == 2 else value(u))
        found = await scan(host, units=(1, 2, 3))
        assert [f.answer.unit for f in found.units] == [1, 3]
        assert any("closes the connection whenever unit 2" in note for note in found.notes)
        assert host.asked.count(2) == 3

    run_virtually(main())


def test_rtu_over_tcp_is_scanned_as_a_line_is() -> None:
    async def main() -> None:
        host = Host(lambda u: value(u) if u == 12 else None, rtu=True)
        found = await scan(host, "rtu+tcp://192.0.2.1:4001", units=tuple(range(1, 20)), timeout_s=0.1)
        assert [f.answer.unit for f in found.units] == [12]

    run_virtually(main())


def test_a_real_fieldtwin_server_is_found() -> None:
    async def main() -> None:
        device = unit(bank([CellSpan("holding", 0, 4)]))
        host = Host(lambda u: device.respond(b"\x03\x00\x00\x00\x01", 0) if u == 5 else b"\x83\x0b")
        found = await scan(host, units=(4, 5, 6))
        assert [f.answer.unit for f in found.units] == [5]

    run_virtually(main())


@given(st.lists(st.binary(max_size=30), max_size=12), st.sampled_from(["rtu", "ascii", "mbap", "udp"]))
@settings(max_examples=80, deadline=None)
def test_a_sweep_ends_for_any_input_and_finds_only_requested_units(chunks: list[bytes], framing: str) -> None:
    units = (1, 2, 3)
    sweep = UnitSweep(framing, units, timeout_ns=50_000_000)  # type: ignore[arg-type]
    now_ns, sends = 0, 0
    while (step := sweep.poll(now_ns)) is not None:
        if isinstance(step, SendRequest):
            sends += 1
            if chunks:
                sweep.feed(chunks.pop(), now_ns + 1000)
            continue
        now_ns = max(now_ns + 1000, step.until_ns)
    assert sends == sweep.asked <= 2 * len(units)
    assert set(sweep.found) <= set(units)


@given(st.sets(st.integers(0, 255), min_size=1))
def test_the_spread_is_some_of_the_units_each_once(units: set[int]) -> None:
    some = spread_over(sorted(units))
    assert len(some) == len(set(some)) == min(SPREAD, len(units))
    assert set(some) <= units


@given(
    st.lists(
        st.builds(UnitAnswer, st.integers(0, 255), st.binary(min_size=2, max_size=4), st.just(0), st.just(0)),
        max_size=8,
    )
)
def test_few_answers_are_never_one_device_for_sure(answers: list[UnitAnswer]) -> None:
    verdict = detect_shared_unit_ids(answers, len(answers))
    assert verdict is None or not verdict.one_device
