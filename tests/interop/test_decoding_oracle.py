"""Our decoding of a trace compared with tshark's decoding of the same bytes."""

from __future__ import annotations

from pathlib import Path

import pytest
from tshark import dissect, needs_tshark

from fieldtwin.capture.decoding.decoder import exchanges, frame_events
from fieldtwin.capture.decoding.exchange import DecodedExchange
from fieldtwin.gateway.connections.tap import Captured
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.connection import Direction
from fieldtwin.gateway.protocols.modbus.frames.crc import with_crc
from fieldtwin.twin.site.system import load_system

pytestmark = [pytest.mark.interop, needs_tshark]
MS = 1_000_000
PDUS = [  # request, reply
    ("03 0000 0002", "03 04 0001 FFFE"), ("04 0000 0003", "04 06 4148 0000 1234"), ("06 0001 0007", "06 0001 0007"),
    ("10 0001 0002 04 000A 0102", "10 0001 0002"), ("03 1000 0001", "83 02"), ("06 0001 8000", "86 03"),
    ("17 0003 0002 000E 0001 02 00FF", "17 04 00FE 0ACD"), ("01 0013 0013", "01 03 CD6B05"), ("05 00AC FF00", "05 00AC FF00"),
]  # fmt: skip
SDOS = [
    ("605#4018100400000000", "585#43181004ED030000"), ("605#2B171000F4010000", "585#6017100000000000"),
    ("605#2F00620103000000", "585#8000620100000206"), ("605#4010600000000000", "585#4B1060009E010000"),
]  # fmt: skip


def captured(bus: str, frames: list[tuple[bool, bytes | CanFrame]]) -> tuple[list[Captured], list[DecodedExchange]]:
    system = load_system("observatory")
    endpoint = system.buses[bus].endpoint
    seen = [
        Captured((i + 1) * MS, endpoint, Direction.SENT if sent else Direction.RECEIVED, item)
        for i, (sent, item) in enumerate(frames)
    ]
    return seen, exchanges(system, frame_events(seen, system))


def numbers(text: str) -> list[int]:
    return [int(n, 0) for n in text.split(",") if n]


@pytest.mark.parametrize("bus", ["line1", "lan"])
def test_modbus_is_decoded_as_by_tshark(bus: str, tmp_path: Path) -> None:
    frames: list[tuple[bool, bytes | CanFrame]] = []
    for number, pair in enumerate(PDUS, 1):
        for sent, pdu in zip((True, False), map(bytes.fromhex, pair), strict=True):
            head = number.to_bytes(2) + b"\0\0" + (len(pdu) + 1).to_bytes(2)
            frames.append((sent, with_crc(b"\x01" + pdu) if bus == "line1" else head + b"\x01" + pdu))
    seen, ours = captured(bus, frames)
    fields = ["modbus.func_code", "modbus.reference_num", "modbus.word_cnt", "modbus.bit_cnt", "modbus.exception_code"]
    packets = dissect(
        tmp_path / "a.pcap", seen, seen[0].endpoint, [*fields, "modbus.regval_uint16", "modbus.read_reference_num"]
    )
    packets = [p for p in packets if p["modbus.func_code"]]
    assert len(packets) == 2 * len(ours) == 2 * len(PDUS)
    for exchange, request, reply in zip(ours, packets[::2], packets[1::2], strict=True):
        assert numbers(request["modbus.func_code"]) == [exchange.function]
        at = numbers(request["modbus.reference_num"] + "," + request["modbus.read_reference_num"])
        # on RTU it cannot always distinguish a request from a reply
        assert exchange.address in at or (bus == "line1" and not at)
        counts = numbers(request["modbus.word_cnt"]) + numbers(request["modbus.bit_cnt"])
        assert not counts or exchange.count in counts
        assert numbers(reply["modbus.exception_code"]) == ([] if exchange.exception is None else [exchange.exception])
        told = numbers(reply["modbus.regval_uint16"])
        if exchange.access == "read" and exchange.function in (3, 4) and exchange.ok:
            assert told == list(exchange.registers)


def test_canopen_is_decoded_as_by_tshark(tmp_path: Path) -> None:
    frames: list[tuple[bool, bytes | CanFrame]] = []
    for pair in SDOS:
        for sent, text in zip((True, False), pair, strict=True):
            cob, _, data = text.partition("#")
            frames.append((sent, CanFrame(int(cob, 16), bytes.fromhex(data))))
    seen, ours = captured("can0", frames)
    fields = ["canopen.sdo.main_idx", "canopen.sdo.sub_idx", "canopen.sdo.abort_code"]
    packets = dissect(tmp_path / "a.pcap", seen, seen[0].endpoint, fields)
    for exchange, request, reply in zip(ours, packets[::2], packets[1::2], strict=True):
        span = exchange.spans[0]
        assert numbers(request["canopen.sdo.main_idx"]) == [span.address]
        assert numbers(request["canopen.sdo.sub_idx"]) == [span.subindex]
        assert numbers(reply["canopen.sdo.abort_code"]) == ([] if exchange.abort is None else [exchange.abort])
