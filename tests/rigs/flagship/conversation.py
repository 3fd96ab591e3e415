"""The content of a capture per device, in a form suited for comparison: exchanges, and frames received without a
request.

It parses frames itself, including checksums, and uses no driver, emulator or profile, because the comparison must be
independent of the code under test.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

from fieldtwin.gateway.connections.tap import Captured
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.connection import Direction

SDO_REPLY, SDO_REQUEST, NMT = 0x580, 0x600, 0x000


@dataclass(frozen=True, slots=True)
class Exchange:
    """A request and its reply, both from the address on: unit ID and PDU, or COB-ID (two bytes) and data.

    `reply` is empty if none arrived. `latency_ms` is measured from the request to the last byte of the reply.
    """

    t_ns: int
    request: bytes
    reply: bytes
    latency_ms: float = 0.0


@dataclass(frozen=True, slots=True)
class Heard:
    """A frame without a request: a TPDO, a heartbeat, an EMCY."""

    t_ns: int
    cob_id: int
    data: bytes


@dataclass
class Conversation:
    """The conversation of one device. `faults` lists violations of its protocol: a wrong CRC, a reply without a
    request."""

    device: str
    exchanges: list[Exchange] = field(default_factory=list)
    heard: list[Heard] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)


def rtu_conversation(device: str, captured: Iterable[Captured]) -> Conversation:
    """Parse a serial line with one unit: bytes between two requests are the reply to the first (SL 2.4.1)."""
    talk = Conversation(device)
    for sent, received in _turns(captured):
        reply = b"".join(_bytes(c) for c in received)
        latency_ms = (received[-1].t_ns - sent.t_ns) / 1e6 if received else 0.0
        for what, frame in (("request", _bytes(sent)), ("reply", reply)):
            if frame and (len(frame) < 4 or crc16(frame[:-2]) != int.from_bytes(frame[-2:], "little")):
                talk.faults.append(f"{what} with a bad CRC: {frame.hex(' ')}")
        talk.exchanges.append(Exchange(sent.t_ns, _bytes(sent)[:-2], reply[:-2], latency_ms))
    return talk


def tcp_conversation(device: str, captured: Iterable[Captured]) -> Conversation:
    """Parse a Modbus TCP connection with one outstanding request. Transaction ids must match, and are dropped."""
    talk = Conversation(device)
    for sent, received in _turns(captured):
        request, reply = _bytes(sent), b"".join(_bytes(c) for c in received)
        latency_ms = (received[-1].t_ns - sent.t_ns) / 1e6 if received else 0.0
        for what, adu in (("request", request), ("reply", reply)):
            if adu and (len(adu) < 8 or adu[2:4] != b"\0\0" or int.from_bytes(adu[4:6]) != len(adu) - 6):
                talk.faults.append(f"{what} with a bad MBAP header: {adu.hex(' ')}")
        if reply and reply[:2] != request[:2]:
            talk.faults.append(f"transaction {request[:2].hex()} answered as {reply[:2].hex()}")
        talk.exchanges.append(Exchange(sent.t_ns, request[6:], reply[6:], latency_ms))
    return talk


def canopen_conversation(device: str, captured: Iterable[Captured], node: int) -> Conversation:
    """Parse the frames of a node: SDO requests with replies, NMT commands and other sent frames (without replies), and
    the rest."""
    talk = Conversation(device)
    for c in captured:
        frame = c.item
        assert isinstance(frame, CanFrame)
        if frame.error or frame.extended or frame.remote:
            talk.faults.append(f"not a CANopen frame: {frame}")
        elif c.direction is Direction.SENT:
            talk.exchanges.append(Exchange(c.t_ns, frame.can_id.to_bytes(2) + frame.data, b""))
        elif frame.can_id == SDO_REPLY + node:
            _sdo_reply(talk, c.t_ns, frame, node)
        else:
            talk.heard.append(Heard(c.t_ns, frame.can_id, frame.data))
    return talk


def _sdo_reply(talk: Conversation, t_ns: int, frame: CanFrame, node: int) -> None:
    asked = next((e for e in reversed(talk.exchanges) if e.request[:2] == (SDO_REQUEST + node).to_bytes(2)), None)
    if asked is None or asked.reply:
        talk.faults.append(f"an SDO reply that nobody asked for: {frame}")
        return
    reply = frame.can_id.to_bytes(2) + frame.data
    answered = Exchange(asked.t_ns, asked.request, reply, (t_ns - asked.t_ns) / 1e6)
    talk.exchanges[talk.exchanges.index(asked)] = answered


def _bytes(captured: Captured) -> bytes:
    assert isinstance(captured.item, bytes)
    return captured.item


def _turns(captured: Iterable[Captured]) -> list[tuple[Captured, list[Captured]]]:
    """Return every sent chunk with the bytes received until the next one."""
    turns: list[tuple[Captured, list[Captured]]] = []
    for c in captured:
        if c.direction is Direction.SENT:
            turns.append((c, []))
        elif turns:
            turns[-1][1].append(c)
    return turns


def crc16(data: bytes) -> int:
    """The serial line's CRC (SL 6.2.2), bit by bit."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0xA001 if crc & 1 else 0)
    return crc
