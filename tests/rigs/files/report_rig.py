"""Helpers for the tests of decoding and reports: handwritten traces of the observatory."""

from __future__ import annotations

import struct
from functools import cache
from typing import Any

from fieldtwin.gateway.protocols.modbus.frames.crc import with_crc
from fieldtwin.results.trace import TraceEvent, TraceKind
from fieldtwin.twin.site.system import System, load_system

MS = 1_000_000


@cache
def observatory() -> System:
    return load_system("observatory")


def chunk(t_ms: float, sent: bool, data: bytes | str, bus: str = "line1") -> TraceEvent:
    raw = bytes.fromhex(data) if isinstance(data, str) else data
    return TraceEvent(int(t_ms * MS), TraceKind.FRAME, bus, {"dir": "sent" if sent else "received", "bytes": raw.hex()})


def ask(t_ms: float, pdu: str, unit: int = 1) -> TraceEvent:
    """A request of the gateway on the serial line."""
    return chunk(t_ms, True, with_crc(bytes([unit]) + bytes.fromhex(pdu)))


def answer(t_ms: float, pdu: str | bytes, unit: int = 1) -> TraceEvent:
    raw = bytes.fromhex(pdu) if isinstance(pdu, str) else pdu
    return chunk(t_ms, False, with_crc(bytes([unit]) + raw))


def adu(transaction: int, pdu: str, unit: int = 1) -> bytes:
    raw = bytes.fromhex(pdu)
    return struct.pack(">HHHB", transaction, 0, len(raw) + 1, unit) + raw


def can(t_ms: float, text: str, **flags: Any) -> TraceEvent:
    """``605#40 18 10 04`` as on a bus; frames that a master sends come from the gateway."""
    number, _, data = text.partition("#")
    can_id, sent = int(number, 16), number in ("000", "080") or number.startswith(("20", "60")) or number == "7E5"
    fields = {"dir": "sent" if sent else "received", "id": can_id, "bytes": bytes.fromhex(data).hex(), **flags}
    return TraceEvent(int(t_ms * MS), TraceKind.FRAME, "can0", fields)


def note(t_ms: float, kind: TraceKind, where: str, **data: Any) -> TraceEvent:
    return TraceEvent(int(t_ms * MS), kind, where, data)


CTD_VALUES = b"\x04\x14" + struct.pack(">fffII", 12.5, 4.25, 3.5, 7, 70_000)
"""A reply to `READ_CTD`: pressure, temperature, conductivity, sample_count, instrument_time."""
READ_CTD = "04 0000 000A"


def run_trace(seconds: int = 20, lost: tuple[float, float] = (12.0, 15.0)) -> list[TraceEvent]:
    """The running observatory: polls, process data, heartbeats, states; `lost`: the time from which the CTD is silent."""
    events = [
        note(0, TraceKind.STATE, "relay.state", value=0), note(0, TraceKind.STATE, "relay.period_s", value=0),
        note(2010, TraceKind.STATE, "relay.period_s", value=1), note(2010, TraceKind.STATE, "relay.state", value=1),
        note(16_000, TraceKind.STATE, "relay.state", value=2), note(18_000, TraceKind.STATE, "relay.state", value=0),
        note(0, TraceKind.STEP, "1", text="topside commands 1 s"), note(2020, TraceKind.STEP, "1", text="", verdict="passed"),
        note(lost[0] * 1000, TraceKind.FAULT, "f1", name="drop", on=True, target="ctd"),
        note(lost[1] * 1000, TraceKind.FAULT, "f1", name="drop", on=False, target="ctd"),
    ]  # fmt: skip
    for half in range(2 * seconds):
        t_ms, bad = 500.0 * half + 3, lost[0] <= half / 2 < lost[1]
        events.append(ask(t_ms, READ_CTD))
        if bad:
            events.append(note(t_ms + 300, TraceKind.TAG, "ctd.pressure", value=None, quality="bad", reason="timeout"))
        else:
            value = struct.unpack(">f", struct.pack(">f", 12.5 + half % 7 / 4))[0]
            reply = b"\x04\x14" + struct.pack(">fffII", value, 4.25, 3.5, half, 500 * half)
            events += [chunk(t_ms + 12, False, with_crc(b"\x01" + reply)[:16])]
            events += [chunk(t_ms + 17.5, False, with_crc(b"\x01" + reply)[16:])]
            for tag, held in (("pressure", value), ("temperature", 4.25), ("sample_count", half)):
                events.append(note(t_ms + 18, TraceKind.TAG, f"ctd.{tag}", value=held, quality="good", reason="none"))
        if half % 2 == 0:
            events += [ask(t_ms + 400, "03 0000 0002"), answer(t_ms + 410, "03 04 0001 0001")]
            events.append(can(t_ms + 50, "705#05"))
        for tenth in range(5):
            at = t_ms + 100 * tenth + 20
            events.append(can(at, "185#" + struct.pack("<hh", 414 + tenth, 53 - half).hex()))
            events.append(
                note(
                    at + 1,
                    TraceKind.TAG,
                    "inclinometer.slope_long",
                    value=4.14 + tenth / 100,
                    quality="good",
                    reason="none",
                )
            )
        events += [chunk(t_ms + 30, True, adu(half + 1, "03 0000 0022"), "lan")]
        events += [chunk(t_ms + 31, False, adu(half + 1, "03 44" + "00" * 68), "lan")]
    return sorted(events, key=lambda e: e.t_ns)
