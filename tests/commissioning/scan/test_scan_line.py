"""`scan` of a serial line with hidden settings, modelled bit by bit: its findings, its certainty, its requests."""

from __future__ import annotations

import pytest
from commissioning_rig import bank, loop, run_virtually, unit
from hypothesis import given, settings
from hypothesis import strategies as st
from uart_line import UartLine, levels, sampled

from fieldtwin.commissioning.access.progress import PhaseProgress
from fieldtwin.commissioning.scan.modbus import ModbusScan, ModbusScanner, ScanOptions
from fieldtwin.commissioning.scan.settings import LIKELY, name_of
from fieldtwin.commissioning.scan.traffic import LineListener
from fieldtwin.emulators.modbus.bank import CellSpan
from fieldtwin.emulators.modbus.rtu.receiver import with_crc
from fieldtwin.emulators.modbus.unit import ModbusUnit
from fieldtwin.gateway.core.endpoint import SerialSettings

PORT = "rtu:/dev/ttyX"


def meter(value: int = 7) -> ModbusUnit:
    return unit(bank([CellSpan("holding", 0, 20)], {"holding": {0: [value]}}))


def exchange(number: int, value: int) -> tuple[bytes, bytes]:
    """A second client reads two registers of a unit."""
    words = value.to_bytes(2, "big") + (65535 - value).to_bytes(2, "big")
    return with_crc(bytes([number, 3, 0, 0, 0, 2])), with_crc(bytes([number, 3, 4]) + words)


async def scan(line: UartLine, url: str = PORT, **options: object) -> ModbusScan:
    told: list[PhaseProgress] = []
    made = ScanOptions(**options)  # type: ignore[arg-type]
    result = await ModbusScanner(url, made, connector=line, clock=loop(), on_progress=told.append).run()
    assert all(p.done_s <= p.total_s + 1e-6 for p in told)
    return result


@given(st.binary(max_size=20), st.sampled_from(LIKELY))
@settings(max_examples=30, deadline=None)
def test_the_model_returns_the_sent_bytes_at_the_same_settings(data: bytes, line: SerialSettings) -> None:
    got = sampled(levels(data, line), line, line)
    assert (got.data, got.parity, got.frame) == (data, 0, 0)


@pytest.mark.parametrize("hidden", ["9600 8N1", "19200 8E1", "115200 8E1", "9600 8O1", "2400 8N1", "19200 8N2"])
def test_a_silent_line_gives_up_its_settings_to_the_quick_pass(hidden: str) -> None:
    async def main() -> None:
        baudrate, frame = hidden.split()
        line = UartLine({3: meter(), 42: meter()}, SerialSettings(int(baudrate), frame))
        found = await scan(line)
        assert [f.answer.unit for f in found.units] == [3, 42]
        assert not any(f.doubtful for f in found.units)
        (at,) = {f.settings for f in found.units}
        assert at is not None
        assert name_of(at) in (hidden, hidden.replace("8N2", "8N1"))
        assert line.sent
        assert not found.stopped
        assert loop().time() > 3.0, "listened first"

    run_virtually(main())


@pytest.mark.parametrize("counts", [True, False])
@pytest.mark.parametrize("hidden", ["9600 8N1", "19200 8E1", "38400 8O1", "57600 8E1", "4800 8N1"])
def test_traffic_reveals_settings_and_units_and_nothing_is_sent(hidden: str, counts: bool) -> None:
    async def main() -> None:
        baudrate, frame = hidden.split()
        talk = (exchange(5, 1234), exchange(9, 99), (exchange(30, 0)[0], None))
        line = UartLine({}, SerialSettings(int(baudrate), frame), counts=counts, chatter=talk)
        found = await scan(line)
        assert line.sent == []
        assert not found.sent
        assert any("--share-bus" in note for note in found.notes)
        verdict = found.verdict
        assert verdict is not None
        assert verdict.heard is not None
        assert verdict.heard.live == [5, 9]
        assert verdict.heard.silent == [30]
        fits = [name_of(s) for s in (verdict.settings, *verdict.others)]
        assert hidden in fits, (verdict, [(name_of(a.settings), a.heard.share, a.errors) for a in found.auditions])
        if verdict.sure:
            assert counts, "parity cannot be known where nothing counts"
            assert name_of(verdict.settings) == hidden

    run_virtually(main())


def test_sharing_a_bus_asks_between_the_exchanges_of_the_other_client() -> None:
    async def main() -> None:
        line = UartLine({7: meter()}, counts=True, chatter=(exchange(5, 1), exchange(6, 2)))
        found = await scan(line, share_bus=True, units=(5, 7, 8))
        assert [f.answer.unit for f in found.units] == [7]
        assert found.heard is not None
        assert found.heard.live == [5, 6]

    run_virtually(main())


def test_listening_only_sends_nothing_on_a_silent_line_either() -> None:
    async def main() -> None:
        line = UartLine({1: meter()})
        found = await scan(line, listen_only=True)
        assert line.sent == []
        assert found.units == []

    run_virtually(main())


def test_noise_is_not_modbus() -> None:
    async def main() -> None:
        line = UartLine({}, counts=True, chatter=((bytes(range(1, 60)), None), (b"$GPGGA,120000*47\r\n", None)))
        found = await scan(line, share_bus=True)
        assert found.verdict is None or not found.verdict.sure
        assert line.sent == []

    run_virtually(main())


def test_every_unit_is_asked_within_the_theoretical_time() -> None:
    async def main() -> None:
        line = UartLine({17: meter()})
        found = await scan(line, f"{PORT}?baudrate=9600&frame=8N1", timeout_s=0.05, per_s=1000, listen_s=0)
        theory_s = 246 * (8 * 10 / 9600 + 0.05)
        assert theory_s < found.took_s < 1.02 * theory_s + 0.2
        assert [f.answer.unit for f in found.units] == [17]
        assert found.asked == 247

    run_virtually(main())


def test_the_rate_limit_holds() -> None:
    async def main() -> None:
        line = UartLine({1: meter(), 2: meter(), 3: meter()})
        began_s = loop().time()
        await scan(line, f"{PORT}?baudrate=115200", units=(1, 2, 3), per_s=2, listen_s=0, timeout_s=0.05)
        assert loop().time() - began_s >= 1.0

    run_virtually(main())


def test_a_late_reply_is_attributed_to_the_slow_unit() -> None:
    async def main() -> None:
        line = UartLine({4: meter()}, latency_s=0.12)
        found = await scan(line, f"{PORT}?baudrate=9600&frame=8N1", units=(3, 4, 5, 6), timeout_s=0.1, listen_s=0)
        assert [(f.answer.unit, f.answer.late) for f in found.units] == [(4, True)]

    run_virtually(main())


def test_damaged_answers_are_asked_for_again_and_reported() -> None:
    async def main() -> None:
        def damage(number: int, reply: bytes) -> bytes:
            return reply[:3] + b"\xff" + reply[4:] if reply[0] == 2 or number == 1 else reply

        line = UartLine({1: meter(), 2: meter()}, damage=damage)
        found = await scan(line, f"{PORT}?baudrate=9600&frame=8N1", units=(1, 2, 3), listen_s=0)
        assert [f.answer.unit for f in found.units] == [1]
        assert [o.units for o in found.damaged] == [(2,)]

    run_virtually(main())


def test_an_exception_proves_presence_and_an_echo_does_not() -> None:
    async def main() -> None:
        line = UartLine({1: unit(bank([CellSpan("input", 5, 1)]))}, echo=True)
        found = await scan(line, f"{PORT}?baudrate=9600&frame=8N1", units=(1, 2), listen_s=0)
        assert [(f.answer.unit, f.answer.exception) for f in found.units] == [(1, 2)]
        assert found.echo

    run_virtually(main())


def test_stopping_keeps_the_results() -> None:
    async def main() -> None:
        line = UartLine({n: meter() for n in range(1, 200)})
        seen: list[PhaseProgress] = []
        scanner = ModbusScanner(
            f"{PORT}?baudrate=9600&frame=8N1",
            ScanOptions(listen_s=0),
            connector=line,
            clock=loop(),
            on_progress=seen.append,
            stop=lambda: bool(seen) and seen[-1].found >= 10,
        )
        found = await scanner.run()
        assert found.stopped
        assert [f.answer.unit for f in found.units] == list(range(1, 11))

    run_virtually(main())


def test_ascii_lines_are_found_as_well() -> None:
    async def main() -> None:
        line = UartLine({2: meter()}, SerialSettings(19200, "7E1"), ascii=True)
        found = await scan(line, "ascii:/dev/ttyX")
        assert [(f.answer.unit, name_of(f.settings)) for f in found.units if f.settings] == [(2, "19200 7E1")]

    run_virtually(main())


@given(st.lists(st.binary(max_size=40), max_size=20))
@settings(max_examples=60, deadline=None)
def test_listening_to_anything_counts_it_and_never_fails(chunks: list[bytes]) -> None:
    listener = LineListener("rtu")
    for i, chunk in enumerate(chunks):
        listener.feed(chunk, i * 20_000_000)
    listener.settle(10**12)
    heard = listener.heard
    assert heard.bytes == sum(map(len, chunks))
    assert 0 <= heard.good_bytes <= heard.bytes


def test_quick_ends_with_the_quick_pass_also_with_results() -> None:
    async def main() -> None:
        found = await scan(UartLine({1: meter(), 200: meter()}), quick_only=True)
        assert [f.answer.unit for f in found.units] == [1]
        assert found.took_s < 34
        assert any("--quick" in note for note in found.notes)

    run_virtually(main())


def test_the_quick_pass_takes_30_s_and_tries_likely_settings_with_likely_units() -> None:
    async def main() -> None:
        line = UartLine({200: meter()})
        found = await scan(line, quick_only=True)
        assert 28 < found.took_s < 34
        assert found.asked >= 130
        assert len(set(line.opened)) >= 10
        assert found.units == []
        assert any("--quick" in note for note in found.notes)

    run_virtually(main())


@pytest.mark.parametrize("said", ["baudrate=14400", "frame=8E1"])
def test_given_settings_are_kept_and_the_rest_is_tried(said: str) -> None:
    async def main() -> None:
        line = UartLine({2: meter()}, SerialSettings(14400 if "14400" in said else 4800, "8E1"))
        found = await scan(line, f"{PORT}?{said}", listen_s=0)
        assert [(f.answer.unit, f.settings) for f in found.units] == [(2, line.settings)]
        assert all(str(s.baudrate) in said or s.frame in said for s in line.opened)

    run_virtually(main())


def test_a_master_that_was_silent_for_long_ends_the_asking() -> None:
    async def main() -> None:
        line = UartLine({40: meter()})
        url = f"{PORT}?baudrate=9600&frame=8N1"
        told: list[PhaseProgress] = []
        scanner = ModbusScanner(url, ScanOptions(listen_s=1), connector=line, clock=loop(), on_progress=told.append)
        line.chatter = (exchange(5, 1),)
        line.opened.append(SerialSettings())  # it does not begin when the port is opened
        loop().call_later(6, line._talk)
        found = await scanner.run()
        assert 5 < found.took_s < 8
        assert found.asked < 20
        assert any("started to send" in note for note in found.notes)

    run_virtually(main())


def test_unproved_settings_are_not_used_for_sending_unless_given() -> None:
    async def main() -> None:
        line = UartLine({7: meter()}, SerialSettings(9600, "8E1"), chatter=(exchange(5, 1), exchange(6, 2)))
        found = await scan(line, share_bus=True, units=(7,))
        assert line.sent == []
        assert any("not certain" in note for note in found.notes)
        said = UartLine({7: meter()}, SerialSettings(9600, "8E1"), chatter=(exchange(5, 1), exchange(6, 2)))
        found = await scan(said, f"{PORT}?baudrate=9600&frame=8E1", share_bus=True, units=(7,))
        assert [f.answer.unit for f in found.units] == [7]

    run_virtually(main())
