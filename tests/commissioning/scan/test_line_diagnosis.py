"""`line`: diagnosis of a line, a bus or a host with known faults; nothing is sent except a requested probe."""

from __future__ import annotations

import asyncio
from dataclasses import replace

import pytest
from canopen_peer_node import PeerBus, PeerNode, closing
from commissioning_rig import loop, run_virtually
from hypothesis import given, settings
from hypothesis import strategies as st
from test_scan_line import exchange, meter
from uart_line import UartLine

from fieldtwin.commissioning.scan.can_listener import ObservedBus
from fieldtwin.commissioning.scan.causes import ScanProbe, SerialEvidence, can_causes, serial_causes, tcp_causes
from fieldtwin.commissioning.scan.line import LineCheckOptions, LineReport, look_at_line, probe_of
from fieldtwin.commissioning.scan.traffic import Heard, LineListener
from fieldtwin.gateway.connections.can.facts import CanFacts
from fieldtwin.gateway.connections.serial.line_counters import UartCounters, unpack_counters
from fieldtwin.gateway.core.endpoint import SerialSettings
from fieldtwin.gateway.core.errors import NotAllowed

PORT = "rtu:/dev/ttyX"
N81 = SerialSettings(9600, "8N1")


async def look(line: UartLine, url: str = f"{PORT}?baudrate=9600&frame=8N1", **options: object) -> LineReport:
    made = LineCheckOptions(listen_s=1.0, **options)  # type: ignore[arg-type]
    return await look_at_line(url, made, connector=line, clock=loop())


def names(report: LineReport) -> list[str]:
    return [c.name for c in report.causes]


def test_a_silent_line_is_not_a_fault_and_nothing_is_sent() -> None:
    async def main() -> None:
        line = UartLine({1: meter()}, counts=True)
        report = await look(line)
        assert line.sent == []
        assert not report.sent
        assert report.healthy
        assert names(report)[0] == "no client sends requests"
        assert dict(report.facts)["control lines"] == "CTS dsr"

    run_virtually(main())


def test_healthy_traffic_is_called_healthy() -> None:
    async def main() -> None:
        line = UartLine({}, counts=True, chatter=(exchange(5, 1), exchange(6, 2)))
        report = await look(line)
        assert (report.healthy, report.causes, line.sent) == (True, [], [])
        assert dict(report.facts)["units that answer"] == "5, 6"

    run_virtually(main())


@pytest.mark.parametrize(
    ("hidden", "cause"),
    [("19200 8E1", "the baud rate"), ("9600 8E1", "the parity or the stop bits"), ("115200 8N1", "the baud rate")],
)
def test_wrong_settings_are_the_first_cause_and_the_right_ones_the_remedy(hidden: str, cause: str) -> None:
    async def main() -> None:
        baudrate, frame = hidden.split()
        line = UartLine(
            {}, SerialSettings(int(baudrate), frame), counts=True, chatter=(exchange(5, 1234), exchange(6, 77))
        )
        report = await look(line)
        assert (report.causes[0].name, report.causes[0].remedy) == (cause, f"use {hidden}")
        assert not report.healthy
        assert line.sent == []

    run_virtually(main())


def test_a_unit_that_never_answers_another_client_is_named() -> None:
    async def main() -> None:
        line = UartLine({}, counts=True, chatter=(exchange(5, 1), (exchange(30, 2)[0], None)))
        report = await look(line)
        assert names(report) == ["units that do not answer"]
        assert "30" in report.causes[0].why

    run_virtually(main())


def test_the_probe_sees_echo_and_answer_and_is_one_question() -> None:
    async def main() -> None:
        line = UartLine({1: meter()}, echo=True)
        report = await look(line, probe_unit=1)
        assert report.probe == ScanProbe(1, "whole", "good", 15)
        assert len(line.sent) == 1
        assert dict(report.facts)["echo"].startswith("yes")
        nobody = UartLine({1: meter()}, echo=True)
        report = await look(nobody, probe_unit=9)
        assert report.probe is not None
        assert (report.probe.echo, report.probe.answer) == ("whole", "none")
        assert "a different unit ID" in names(report)
        assert not report.healthy

    run_virtually(main())


def test_no_probe_is_sent_into_foreign_traffic_without_permission() -> None:
    async def main() -> None:
        line = UartLine({1: meter()}, counts=True, chatter=(exchange(5, 1),))
        with pytest.raises(NotAllowed, match="carries traffic"):
            await look(line, probe_unit=1)
        assert line.sent == []
        report = await look(line, probe_unit=1, share_bus=True)
        assert report.probe is not None
        assert report.probe.answer == "good"

    run_virtually(main())


def test_a_bus_with_traffic_and_one_with_errors() -> None:
    async def main() -> None:
        node = PeerNode(5, {}, heartbeat_s=0.2)
        peers = PeerBus([node])
        async with closing(peers):
            node.power_on()
            report = await look_at_line(
                "can:fieldtwin/h:1", LineCheckOptions(listen_s=1), connector=peers, clock=loop()
            )
            assert peers.sent == []
        assert report.healthy
        assert dict(report.facts)["nodes heard"] == "5"

    run_virtually(main())


def heard_of(data: bytes) -> Heard:
    listener = LineListener("rtu")
    for i in range(0, len(data), 16):
        listener.feed(data[i : i + 16], i * 10_000_000)
    listener.settle(1 << 60)
    return listener.heard


@pytest.mark.parametrize(
    ("evidence", "first"),
    [
        (SerialEvidence(N81, heard_of(b""), UartCounters(breaks=30, frame=30)), "A and B swapped"),
        (SerialEvidence(N81, heard_of(b"$GPGGA,123519,4807.038,N*47\r\n" * 5)), "another protocol"),
        (SerialEvidence(N81, heard_of(b"\x00\xf8\x80\x00\xe0\xff\x00\xf8" * 10)), "the baud rate"),
        (
            SerialEvidence(N81, heard_of(bytes(range(0, 250, 3))), UartCounters(parity=40)),
            "the parity or the stop bits",
        ),
        (SerialEvidence(N81, heard_of(bytes(range(0, 250, 3))), UartCounters(frame=40)), "the baud rate"),
        (SerialEvidence(N81, heard_of(b""), None, probe=ScanProbe(1, "damaged", "none", 8)), "termination or noise"),
        (SerialEvidence(N81, heard_of(b""), None, probe=ScanProbe(1, "none", "none")), "a different unit ID"),
        (SerialEvidence(N81, heard_of(exchange(5, 1)[0] * 20)), "only the client is received"),
        (SerialEvidence(N81, heard_of(b"".join((*exchange(5, 1), b"\x00") * 10))), "direction control"),
        (SerialEvidence(N81, heard_of(b"x"), UartCounters(overrun=3)), "the baud rate"),
    ],
)
def test_known_faults_come_first(evidence: SerialEvidence, first: str) -> None:
    found = serial_causes(evidence)
    likeliest = [c.name for c in found if not c.harmless]
    if evidence.errors is not None and evidence.errors.overrun:
        assert "this computer reads too slowly" in likeliest
    assert likeliest[0] == first or (first == "the baud rate" and likeliest[0] == "this computer reads too slowly"), (
        found
    )


@pytest.mark.parametrize(
    ("facts", "heard", "first"),
    [
        (CanFacts("socketcan", state="bus-off", tx_errors=255), ObservedBus(), "the controller is off"),
        (CanFacts("socketcan", tx_errors=128), ObservedBus(), "alone on the bus"),
        (CanFacts("socketcan"), ObservedBus(errors=9), "the bit rate"),
        (CanFacts("socketcan"), ObservedBus(errors=9, frames=9), "termination or noise"),
        (CanFacts("socketcan"), ObservedBus(), "no node sends"),
    ],
)
def test_faults_of_a_bus(facts: CanFacts, heard: ObservedBus, first: str) -> None:
    assert can_causes(facts, heard, 0.0)[0].name == first
    assert can_causes(replace(facts, state="", tx_errors=0), replace(heard, errors=0, frames=5), 0.1) == []


@pytest.mark.parametrize(
    ("problem", "heard", "hung_up", "first"),
    [
        ("connection refused", b"", False, "no program listens there"),
        ("no answer", b"", False, "the host is off, or a firewall drops packets"),
        ("", b"", True, "no room for another client"),
        ("", b"SSH-2.0", False, "another protocol"),
        ("", b"", False, ""),
    ],
)
def test_faults_of_a_host(problem: str, heard: bytes, hung_up: bool, first: str) -> None:
    found = tcp_causes(problem, heard, hung_up, 502)
    assert (found[0].name if found else "") == first


def test_a_host_that_hangs_up_is_found_out_without_sending() -> None:
    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.close()
        await writer.wait_closed()

    async def main() -> None:
        server = await asyncio.start_server(serve, "127.0.0.1", 0)
        port = server.sockets[0].getsockname()[1]
        report = await look_at_line(f"tcp://127.0.0.1:{port}", LineCheckOptions(listen_s=5))
        assert report.causes[0].name == "no room for another client"
        server.close()
        await server.wait_closed()
        report = await look_at_line(f"tcp://127.0.0.1:{port}", LineCheckOptions(listen_s=5))
        assert report.causes[0].name == "no program listens there"

    asyncio.run(main())


def test_the_kernels_counters_are_read_in_their_order() -> None:
    import struct

    counted = unpack_counters(struct.pack("@20i", *range(1, 12), *[0] * 9))
    assert counted == UartCounters(rx=5, tx=6, frame=7, overrun=8, parity=9, breaks=10, buffer_overrun=11)
    wrapped = UartCounters(rx=2).since(UartCounters(rx=0xFFFF_FFFF))
    assert wrapped.rx == 3


@given(st.binary(min_size=8, max_size=8), st.binary(max_size=30))
def test_an_echo_is_seen_before_an_answer(sent: bytes, rest: bytes) -> None:
    probe = probe_of(1, sent, sent + rest, answered=False)
    assert probe.echo == "whole"
    assert probe.answer == ("damaged" if rest else "none")


@given(st.binary(max_size=200), st.booleans())
@settings(max_examples=60, deadline=None)
def test_any_traffic_gives_a_ranked_list(data: bytes, counts: bool) -> None:
    found = serial_causes(SerialEvidence(N81, heard_of(data), UartCounters() if counts else None))
    weights = [c.weight for c in found]
    assert weights == sorted(weights, reverse=True)
    assert all(c.name and c.why for c in found)
