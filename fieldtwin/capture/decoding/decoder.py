"""The interface of decoding: it converts the events of a trace to texts and exchanges, event by event or all at once.

    decoder = Decoder(system)
    for event in trace.events:
        for exchange in decoder.feed(event): ...
    rest = decoder.finish()

The memory for open requests is bounded: one request per serial line, 64 per Modbus TCP connection, one transfer per CANopen
node.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from typing import Any

from fieldtwin.capture.decoding.canopen_bus import CanopenBusDecoder
from fieldtwin.capture.decoding.canopen_fields import canopen_fields
from fieldtwin.capture.decoding.exchange import Decoded, DecodedExchange
from fieldtwin.capture.decoding.fields import FieldSpan
from fieldtwin.capture.decoding.modbus_connection import KnownUnit, ModbusConnectionDecoder
from fieldtwin.capture.decoding.modbus_fields import modbus_fields
from fieldtwin.capture.decoding.tags import TagMap, show_value
from fieldtwin.gateway.connections.tap import Captured
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.connection import Direction
from fieldtwin.gateway.core.errors import FieldtwinError
from fieldtwin.gateway.devices.config import DeviceConfig
from fieldtwin.gateway.protocols.modbus.frames.selection import framing_of
from fieldtwin.results.trace import TraceEvent, TraceKind, refusal_text
from fieldtwin.twin.site.system import System


class Decoder:
    """A decoder of one trace, whose events are fed in order.

    `served` are buses on which the remote client sends requests. `framings` states the protocol on endpoints that are not a bus
    of `system`: rtu, ascii, mbap, udp or can; their traffic is decoded without names of devices and tags.
    """

    def __init__(
        self, system: System | None, served: Collection[str] = (), framings: Mapping[str, str] | None = None
    ) -> None:
        self._system = system
        self._served = served
        self._framings = framings or {}
        self._modbus: dict[str, ModbusConnectionDecoder] = {}
        self._canopen: dict[str, CanopenBusDecoder] = {}
        self._maps: dict[str, TagMap] = {}

    def decode(self, event: TraceEvent) -> Decoded:
        """Describe an event in words.

        Every event of a trace has a description. For the bytes of an unknown bus the description contains the bytes themselves.
        """
        if event.kind is not TraceKind.FRAME:
            return Decoded(self._words(event), dict(event.data))
        text, done = self._frame(event)
        fields: dict[str, Any] = {"bus": event.where, **event.data}
        if done:
            fields |= done[-1].describe()
        return Decoded(text, fields, tuple(done))

    def feed(self, event: TraceEvent) -> list[DecodedExchange]:
        """Return the exchanges that an event ended: by an answer, by the next request (the old one stays unanswered), or as a
        message that needs no answer.
        """
        return self._frame(event)[1] if event.kind is TraceKind.FRAME else []

    def finish(self) -> list[DecodedExchange]:
        """End the trace: return the requests that are still open, as unanswered."""
        wires: list[ModbusConnectionDecoder | CanopenBusDecoder] = [*self._modbus.values(), *self._canopen.values()]
        return sorted((e for wire in wires for e in wire.finish()), key=lambda e: e.t_ns)

    def pending(self) -> list[DecodedExchange]:
        """Return the requests whose reply may still come, the oldest first. Changes nothing, so it may be called at any time."""
        wires: list[ModbusConnectionDecoder | CanopenBusDecoder] = [*self._modbus.values(), *self._canopen.values()]
        return sorted((e for wire in wires for e in wire.pending()), key=lambda e: e.t_ns)

    def fields(self, event: TraceEvent, request: bytes = b"") -> list[FieldSpan]:
        """Explain the bytes of a frame field by field, with the present knowledge about its bus.

        `request` is the whole frame that a reply answers. Nothing is returned for a frame that cannot be read.
        """
        data = event.data
        try:
            raw = bytes.fromhex(data.get("bytes", ""))
            if "id" in data:
                return canopen_fields(can_frame(data, raw), self._can(event.where).nodes)
        except (ValueError, TypeError, FieldtwinError):
            return []
        wire = self._line(event.where)
        if wire is None:
            return [FieldSpan(0, len(raw), "bytes", raw.hex(" "), "The protocol of this bus is not known.")]
        is_request = (data.get("dir") == "sent") != wire.served
        return modbus_fields(wire.framing, is_request, raw, request, wire.tags)

    def _frame(self, event: TraceEvent) -> tuple[str, list[DecodedExchange]]:
        data = event.data
        try:
            raw = bytes.fromhex(data.get("bytes", ""))
            if "id" in data:
                return self._can(event.where).feed(can_frame(data, raw), event.t_ns)
        except (ValueError, TypeError, FieldtwinError):
            return f"unreadable: {data}", []
        wire = self._line(event.where)
        if wire is None:
            return raw.hex(" "), []
        texts, done = wire.feed(data.get("dir") == "sent", raw, event.t_ns)
        return "; ".join(texts), done

    def _line(self, bus: str) -> ModbusConnectionDecoder | None:
        if bus not in self._modbus:
            config = self._system.buses.get(bus) if self._system else None
            if config is not None and config.endpoint.is_can:
                return None
            framing = framing_of(config.endpoint) if config else self._framings.get(bus, "can")
            if framing == "can":
                return None
            units = {d.address: KnownUnit(d.name, TagMap(d.profile)) for d in self._devices(bus)}
            echo = config.echo if config else False
            self._modbus[bus] = ModbusConnectionDecoder(bus, framing, units, echo=echo, served=bus in self._served)
        return self._modbus[bus]

    def _can(self, bus: str) -> CanopenBusDecoder:
        if bus not in self._canopen:
            self._canopen[bus] = CanopenBusDecoder(bus, self._devices(bus))
        return self._canopen[bus]

    def _devices(self, bus: str) -> list[DeviceConfig]:
        return self._system.devices_on(bus) if self._system else []

    def _words(self, event: TraceEvent) -> str:
        data, where = event.data, event.where
        match event.kind:
            case TraceKind.TAG:
                quality = data.get("quality", "")
                reason = "" if data.get("reason") in (None, "", "none") else f": {data['reason']}"
                return f"{where} {self._tag_value(where, data.get('value'))}, {quality}{reason}"
            case TraceKind.STATE:
                return f"{where} = {show_value(data.get('value'))}"
            case TraceKind.ALARM:
                by = f" by {data['by']}" if data.get("by") else ""
                return f"{where}: {data.get('value')}{by}, {data.get('quality')}"
            case TraceKind.FAULT:
                state = "on" if data.get("on") else "off"
                return f"fault {where}: {data.get('name', '')} {state} {data.get('target') or ''}".rstrip()
            case TraceKind.REFUSED:
                return refusal_text(where, data)
            case TraceKind.STEP:
                verdict = f": {data['verdict']}" if data.get("verdict") else ""
                return f"step {where}: {data.get('text', '')}{verdict}"
        return f"{where}: {data.get('text', '')}"

    def _tag_value(self, where: str, value: Any) -> str:
        device, _, name = where.rpartition(".")
        config = self._system.devices.get(device) if self._system else None
        if config is None or not isinstance(value, bool | int | float | str | None):
            return show_value(value)
        if device not in self._maps:
            self._maps[device] = TagMap(config.profile)
        return self._maps[device].show({name: value}).removeprefix(f"{name} ")


def direction_of(data: Mapping[str, Any]) -> Direction:
    """Return the direction of a FRAME event."""
    return Direction.SENT if data.get("dir") == "sent" else Direction.RECEIVED


def can_frame(data: Mapping[str, Any], raw: bytes) -> CanFrame:
    """Return the CAN frame of a FRAME event, whose bytes are `raw`. Raises `ValueError`, `TypeError` or `FieldtwinError`."""
    return CanFrame(
        data["id"], raw, extended=bool(data.get("ext")), remote=bool(data.get("rtr")), error=bool(data.get("err"))
    )


def exchanges(system: System, events: Iterable[TraceEvent], served: Collection[str] = ()) -> list[DecodedExchange]:
    """Return all exchanges of a trace, in the order of their requests."""
    decoder = Decoder(system, served)
    found = [exchange for event in events for exchange in decoder.feed(event)]
    return sorted(found + decoder.finish(), key=lambda e: (e.t_ns, e.end_ns))


def frame_events(captured: Iterable[Captured], system: System, start_ns: int = 0) -> list[TraceEvent]:
    """Return the traffic of a capture (`fieldtwin run --capture`) as FRAME events.

    `start_ns` is the time of the run's start on the clock of the capture. Endpoints that do not belong to a bus of the system are
    omitted.
    """
    buses = {str(bus.endpoint): name for name, bus in system.buses.items()}
    found = []
    for seen in captured:
        bus = buses.get(str(seen.endpoint))
        if bus is not None:
            found.append(frame_event(seen, bus, start_ns))
    return found


def frame_event(seen: Captured, bus: str, start_ns: int = 0) -> TraceEvent:
    """Return one chunk or CAN frame of a capture as a FRAME event of `bus`."""
    data: dict[str, Any] = {"dir": "sent" if seen.direction is Direction.SENT else "received"}
    if isinstance(seen.item, CanFrame):
        data |= {"bytes": seen.item.data.hex(), "id": seen.item.can_id}
        data |= {k: True for k, on in _flags(seen.item) if on}
    else:
        data["bytes"] = seen.item.hex()
    return TraceEvent(seen.t_ns - start_ns, TraceKind.FRAME, bus, data)


def _flags(frame: CanFrame) -> list[tuple[str, bool]]:
    return [("ext", frame.extended), ("rtr", frame.remote), ("err", frame.error)]
