"""The frames of a run as a pcapng file, for Wireshark: a bus is an interface, and a packet has its decoded text as comment."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from fieldtwin.capture.decoding.decoder import Decoder, can_frame, direction_of
from fieldtwin.capture.formats.pcap import commented_packets, link_type
from fieldtwin.capture.formats.pcapng import Wire, write_pcapng
from fieldtwin.gateway.connections.tap import Captured
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.connection import Direction
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import FieldtwinError
from fieldtwin.results.trace import TraceEvent, TraceKind
from fieldtwin.twin.site.system import System

Events = Callable[[], Iterable[TraceEvent]]
"""Returns the events of a run from the start, each time that it is called."""


def write_packets(path: Path, events: Events, system: System, *, start_utc_ns: int = 0, comment: str = "") -> int:
    """Write the frames of the system's buses; return the number of packets.

    `start_utc_ns` is the time of the run's start in ns since 1970. Buses without frames, and frames of other buses, are left out.
    Raises `FileInvalid` if the file cannot be written, and `UsageError` for too many buses.
    """
    seen = {event.where for event in events() if event.kind is TraceKind.FRAME}
    wires = []
    for number, bus in enumerate(bus for bus in system.buses if bus in seen):
        endpoint = system.buses[bus].endpoint
        explained = _explained(events(), bus, endpoint, system)
        made = commented_packets(explained, endpoint, server=number)
        wires.append(Wire(link_type(endpoint), bus, str(endpoint), made))
    return write_pcapng(path, wires, comment=comment, utc_offset_ns=start_utc_ns)


def _explained(
    events: Iterable[TraceEvent], bus: str, endpoint: Endpoint, system: System
) -> Iterator[tuple[Captured, str]]:
    """Yield the frames of a bus with their decoded texts. The piece of a reply has none: its last piece has the text."""
    decoder = Decoder(system)
    for event in events:
        if event.kind is TraceKind.FRAME and event.where == bus and (item := frame_item(event.data)) is not None:
            decoded, direction = decoder.decode(event), direction_of(event.data)
            piece = direction is Direction.RECEIVED and isinstance(item, bytes) and not decoded.exchanges
            yield Captured(event.t_ns, endpoint, direction, item), "" if piece else decoded.text


def frame_item(data: Mapping[str, Any]) -> bytes | CanFrame | None:
    """Return the bytes or the CAN frame of a FRAME event, None if it has neither."""
    try:
        raw = bytes.fromhex(data["bytes"])
        return can_frame(data, raw) if "id" in data else raw
    except (KeyError, ValueError, TypeError, FieldtwinError):
        return None
