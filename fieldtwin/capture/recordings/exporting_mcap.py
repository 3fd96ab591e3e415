"""Export recordings, captures and CAN logs as MCAP, for Foxglove: topics for exchanges, frames, tags and signals."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

from fieldtwin.capture.decoding.modbus_pdu import parse_reply, parse_request
from fieldtwin.capture.decoding.tags import TagMap
from fieldtwin.capture.formats.mcap_file import (
    EXCHANGE,
    FRAME,
    McapFile,
    group_schema,
    group_value,
)
from fieldtwin.capture.formats.pcap import read_capture, utc_offset_ns
from fieldtwin.capture.formats.pcapng import interface_names
from fieldtwin.capture.recordings.exporting_packets import start_ns
from fieldtwin.capture.recordings.rotating_file import exchanges_of, parts_of
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.connection import Direction
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.files.candump import read_log
from fieldtwin.gateway.core.files.profile import DeviceProfile, Tag
from fieldtwin.gateway.core.files.recording import RecordedExchange, RecordingHeader, RecordingReader
from fieldtwin.gateway.core.values import Scalar

Write = Callable[[Path], int]
"""Writes a file and returns the number of messages."""


def log_mcap(path: Path) -> Write:
    """Return the function that writes the frames of a CAN log."""
    logged = ((t_ns, channel, frame) for part in parts_of(path) for t_ns, channel, frame in read_log(part))
    frames = ((t_ns, frame_message(channel, Direction.RECEIVED, frame)) for t_ns, channel, frame in logged)
    return lambda out: _write_frames(out, path, frames)


def capture_mcap(path: Path, endpoints: Sequence[Endpoint]) -> Write:
    """Return the function that writes the traffic of a capture with these endpoints."""
    offset_ns = utc_offset_ns(parts_of(path)[0])
    names = dict(zip(endpoints, interface_names(endpoints), strict=True))
    captured = (c for part in parts_of(path) for c in read_capture(part) if c.endpoint in names)
    frames = ((c.t_ns + offset_ns, frame_message(names[c.endpoint], c.direction, c.item)) for c in captured)
    return lambda out: _write_frames(out, path, frames)


def frame_message(bus: str, direction: Direction, item: bytes | CanFrame, text: str = "") -> dict[str, Any]:
    """Return a message of the schema `FRAME`."""
    found: dict[str, Any] = {"bus": bus, "direction": direction.value}
    if isinstance(item, CanFrame):
        found |= {"bytes": item.data.hex(), "can_id": item.can_id}
        found |= {"extended": item.extended, "remote": item.remote, "error": item.error}
    else:
        found["bytes"] = item.hex()
    return found | {"text": text} if text else found


def _write_frames(out: Path, path: Path, frames: Iterable[tuple[int, dict[str, Any]]]) -> int:
    with McapFile(out, {"source": path.name}) as file:
        for t_ns, message in frames:
            file.message("/frames", FRAME, t_ns, message)
    return file.messages


def signals_mcap(path: Path, header: RecordingHeader) -> Write:
    """Return the function that writes the signals of a recording as the topic ``/signals``."""
    units = {name: signal.unit for name, signal in header.signals.items()}
    schema = group_schema("fieldtwin.Signals", dict.fromkeys(units, float), units)

    def write(out: Path) -> int:
        with McapFile(out, _about(path, header)) as file:
            for part in parts_of(path):
                with RecordingReader(part) as reader:
                    for row in reader.rows():
                        values = zip(units.items(), row.values, strict=True)
                        message = {name: group_value(value, float, unit=unit) for (name, unit), value in values}
                        file.message("/signals", schema, start_ns(header) + round(row.t_s * NS_PER_S), message)
        return file.messages

    return write


def exchanges_mcap(path: Path, header: RecordingHeader, profile: DeviceProfile | None) -> Write:
    """Return the function that writes exchanges as the topic ``/exchanges``, and with `profile` the tags that they carried as
    ``/tags/unitN``.
    """
    tags = None if profile is None else _RecordedTags(profile)

    def write(out: Path) -> int:
        begin_ns = start_ns(header)
        with McapFile(out, _about(path, header)) as file:
            for e in exchanges_of(path):
                sent_ns = begin_ns + round(e.t_s * NS_PER_S)
                file.message("/exchanges", EXCHANGE, sent_ns, _exchange(e, header.device))
                if tags is not None and (message := tags.message(e)):
                    at_ns = sent_ns + round(e.latency_s * NS_PER_S)
                    file.message(f"/tags/unit{e.unit}", tags.schema, at_ns, message)
        return file.messages

    return write


def _about(path: Path, header: RecordingHeader) -> dict[str, str]:
    found = {
        "source": path.name, "device": header.device, "recorded": header.source, "endpoint": header.endpoint,
        "made_by": header.made_by, "start_utc": header.start_utc, "prototype": str(header.prototype).lower(),
    }  # fmt: skip
    return {key: text for key, text in found.items() if text}


def _exchange(e: RecordedExchange, device: str) -> dict[str, Any]:
    """Return a message of the schema `EXCHANGE`."""
    asked = parse_request(e.request)
    span = asked.spans[0] if asked.spans else None
    found: dict[str, Any] = {"device": device, "unit": e.unit, "service": asked.service}
    if span is not None:
        found |= {"table": span.table, "address": span.address, "count": span.count}
    found |= {"problem": problem_of(e), "request": e.request.hex()}
    if e.reply:
        found |= {"latency_ms": round(1000 * e.latency_s, 3), "reply": e.reply.hex()}
    return found


def problem_of(e: RecordedExchange) -> str:
    """Return why an exchange has no good reply: ``timeout``, ``exception 02`` and so on; "" for a good one."""
    if e.reply is None:
        return e.error or "lost"
    return f"exception {e.reply[1]:02X}" if len(e.reply) == 2 and e.reply[0] & 0x80 else ""


class _RecordedTags:
    """The tags of a profile in the exchanges of a recording. Secret tags are left out."""

    def __init__(self, profile: DeviceProfile) -> None:
        self._map = TagMap(profile)
        self._tags = {name: tag for name, tag in profile.tags.items() if not tag.secret}
        self._kinds = {name: _kind(tag) for name, tag in self._tags.items()}
        self.schema = group_schema(profile.name, self._kinds, {name: tag.unit for name, tag in self._tags.items()})

    def message(self, e: RecordedExchange) -> dict[str, Any]:
        """Return the values of the tags that an exchange carried, and those that it requested in vain as bad."""
        asked, problem, t_ns = parse_request(e.request), problem_of(e), round(e.t_s * NS_PER_S)
        found: dict[str, Scalar | None] = {}
        if problem:
            if asked.read_span is not None:
                found = dict.fromkeys(self._map.names(asked.read_span))
        else:
            if asked.write_span is not None and asked.written:
                found |= self._map.of_registers(asked.write_span, asked.written, t_ns)
            if e.reply and asked.read_span is not None and (read := parse_reply(asked, e.request, e.reply).read):
                found |= self._map.of_registers(asked.read_span, read, t_ns)
        return dict(self._values(found, problem))

    def _values(self, found: dict[str, Scalar | None], problem: str) -> Iterator[tuple[str, dict[str, Any]]]:
        for name, value in found.items():
            tag = self._tags.get(name)
            if tag is None:  # secret, or a message in hex
                continue
            missing = value is None
            yield name, group_value(
                value, self._kinds[name], quality="bad" if missing else "good",
                reason=(problem or "no value") if missing else "", unit=tag.unit,
                name=dict(tag.values).get(value, "") if isinstance(value, int) else "",
            )  # fmt: skip


def _kind(tag: Tag) -> type:
    return str if tag.is_text else bool if tag.is_bit else float
