"""Export recordings, captures and CAN logs as packets: pcap (one conversation) and pcapng (several interfaces, comments)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from fieldtwin.capture.formats.pcap import (
    commented_packets,
    link_type,
    packets,
    read_capture,
    utc_ns,
    utc_offset_ns,
    write_pcap,
)
from fieldtwin.capture.formats.pcapng import Wire, interface_names, write_pcapng
from fieldtwin.capture.recordings.rotating_file import exchanges_of, parts_of
from fieldtwin.gateway.connections.tap import Captured
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.connection import Direction
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.files.candump import read_log
from fieldtwin.gateway.core.files.recording import RecordingHeader
from fieldtwin.gateway.protocols.modbus.frames.crc import with_crc

PCAPNG = ".pcapng"
_BUS = Endpoint.parse("can:socketcan/can0")

Write = Callable[[Path], int]
"""Writes a file and returns the number of packets."""


def log_packets(path: Path, kind: str) -> Write:
    """Return the function that writes a CAN log as `kind`. In pcapng each channel of the log is an interface."""
    if kind != PCAPNG:
        return lambda out: write_pcap(out, _logged(path), _BUS)
    channels = list(dict.fromkeys(channel for part in parts_of(path) for _, channel, _ in read_log(part)))
    link = link_type(_BUS)
    wires = [Wire(link, name, "CAN", packets(_logged(path, name), _BUS)) for name in channels]
    return lambda out: write_pcapng(out, wires, comment=path.name)


def _logged(path: Path, channel: str = "") -> Iterator[Captured]:
    """Yield the frames of a CAN log as captured on one bus: all of them, or those of one channel."""
    for part in parts_of(path):
        for t_ns, seen_on, frame in read_log(part):
            if channel in ("", seen_on):
                yield Captured(t_ns, _BUS, Direction.RECEIVED, frame)


def capture_packets(path: Path, kind: str, endpoints: Sequence[Endpoint]) -> Write:
    """Return the function that writes the traffic of a capture with these endpoints as `kind`. A pcap file has one endpoint."""
    offset_ns = utc_offset_ns(parts_of(path)[0])
    if kind != PCAPNG:
        (endpoint,) = endpoints
        return lambda out: write_pcap(out, _captured(path), endpoint, offset_ns)
    wires = [
        Wire(link_type(endpoint), name, str(endpoint), packets(_captured(path), endpoint, server=number))
        for number, (endpoint, name) in enumerate(zip(endpoints, interface_names(endpoints), strict=True))
    ]
    return lambda out: write_pcapng(out, wires, comment=path.name, utc_offset_ns=offset_ns)


def _captured(path: Path) -> Iterator[Captured]:
    for part in parts_of(path):
        yield from read_capture(part)


def start_ns(header: RecordingHeader) -> int:
    """Return the start of a recording in nanoseconds since 1970."""
    try:
        return utc_ns(header.start_utc)
    except (ValueError, OverflowError):
        # the time is unknown: one second after the start of 1970, so that an earlier handshake can be dated too
        return NS_PER_S


def exchange_packets(path: Path, header: RecordingHeader, kind: str, framing: str) -> Write:
    """Return the function that writes the exchanges of a recording as one conversation: Modbus TCP to port 502, or bare RTU
    frames.

    A broadcast and an unanswered request have no reply; in pcapng a comment states the reason.
    """
    endpoint = Endpoint.parse("tcp://192.0.2.2:502" if framing == "mbap" else "rtu:line")
    if kind != PCAPNG:
        return lambda out: write_pcap(out, (c for c, _ in _frames(path, endpoint)), endpoint, start_ns(header))
    made = commented_packets(_frames(path, endpoint), endpoint)
    wire = Wire(link_type(endpoint), header.device, header.endpoint, made)
    comment = f"{path.name}: {header.device}, {header.source}{', of an emulator' if header.prototype else ''}"
    return lambda out: write_pcapng(out, [wire], comment=comment, utc_offset_ns=start_ns(header))


def _frames(path: Path, endpoint: Endpoint) -> Iterator[tuple[Captured, str]]:
    """Yield the requests and replies of a recording as frames on `endpoint`. The comment of a request without a reply is the
    reason.
    """
    for number, e in enumerate(exchanges_of(path)):
        sent_ns = round(e.t_s * NS_PER_S)
        said = [(sent_ns, Direction.SENT, e.request, f"no reply: {e.error}" if e.error else "")]
        if e.reply:
            said.append((sent_ns + round(e.latency_s * NS_PER_S), Direction.RECEIVED, e.reply, ""))
        for t_ns, direction, pdu, comment in said:
            if endpoint.scheme == "tcp":
                adu = (number & 0xFFFF).to_bytes(2) + bytes(2) + (len(pdu) + 1).to_bytes(2) + bytes((e.unit,)) + pdu
            else:
                adu = with_crc(bytes((e.unit,)) + pdu)
            yield Captured(t_ns, endpoint, direction, adu), comment
