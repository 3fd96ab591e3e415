"""A run as an MCAP file, for Foxglove and other viewers of time series.

==================  =====================================================================================================
``/tags/DEVICE``    the tags of a device that changed: value, quality, reason, unit (`group_value`)
``/programs/NAME``  the variables of a program of the PLC that changed
``/exchanges``      requests with their replies, at the time of the request
``/frames``         the bytes of the buses, with their decoded text
``/faults``         faults that begin and end
``/log``            faults, steps of a scenario, refused writes and notes, as text
==================  =====================================================================================================

Tags that are secret are left out of all topics but ``/frames``, which holds the bytes of the buses.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from fieldtwin.capture.decoding.decoder import Decoder, direction_of
from fieldtwin.capture.decoding.exchange import DecodedExchange
from fieldtwin.capture.formats.mcap_file import (
    ERROR,
    EXCHANGE,
    FAULT,
    FRAME,
    INFO,
    LOG,
    WARNING,
    McapFile,
    Schema,
    group_schema,
    group_value,
    kind_of_values,
    log_message,
)
from fieldtwin.capture.recordings.exporting_mcap import frame_message
from fieldtwin.gateway.core.files.profile import Tag
from fieldtwin.reports.run.packets import Events, frame_item
from fieldtwin.results.trace import TraceEvent, TraceKind
from fieldtwin.results.trace_about import TraceAbout
from fieldtwin.twin.site.system import System

_GROUPED = {TraceKind.TAG: "/tags/", TraceKind.STATE: "/programs/"}


def write_mcap(
    path: Path,
    events: Events,
    system: System,
    *,
    start_utc_ns: int = 0,
    about: Mapping[str, str] | None = None,
    description: TraceAbout | None = None,
) -> int:
    """Write the events of a run; return the number of messages. `events` is called twice.

    `start_utc_ns` is the time of the run's start in ns since 1970, and `about` more of the file's metadata. `description` has the
    names of the programs' states. Raises `FileInvalid` if the file cannot be written, and `UsageError` without the extra.
    """
    metadata = {"system": system.name, "system_hash": system.hash, **(about or {})}
    with McapFile(path, metadata) as file:
        writer = _RunWriter(file, system, start_utc_ns, description)
        writer.prepare(events())
        for event in events():
            writer.add(event)
        writer.finish()
    return file.messages


class _RunWriter:
    """The conversion of one run. Values of a group that change at the same time are one message."""

    def __init__(self, file: McapFile, system: System, start_utc_ns: int, description: TraceAbout | None) -> None:
        self._file = file
        self._start_ns = start_utc_ns
        self._decoder = Decoder(system)
        self._tags = {f"{d.name}.{t.name}": t for d in system.devices.values() for t in d.profile.tags.values()}
        self._words = _words(description)
        self._kinds: dict[str, dict[str, type]] = {}
        self._schemas: dict[str, Schema] = {}
        self._waiting: dict[str, dict[str, Any]] = {}
        self._waiting_ns = 0

    def prepare(self, events: Iterable[TraceEvent]) -> None:
        """Find the names and types of all values, because the schema of a topic is written before its first message."""
        types: dict[str, dict[str, set[type]]] = {}
        for event in events:
            if event.kind in _GROUPED and not self._is_secret(event):
                topic, name = _place(event)
                types.setdefault(topic, {}).setdefault(name, set()).add(type(event.data.get("value")))
        for topic, group in types.items():
            self._kinds[topic] = {name: kind_of_values(found) for name, found in group.items()}
            units = {name: tag.unit for name in group if (tag := self._tag(topic, name)) is not None}
            self._schemas[topic] = group_schema(topic, self._kinds[topic], units)

    def add(self, event: TraceEvent) -> None:
        """Write an event, or keep it until the time advances."""
        if event.t_ns != self._waiting_ns:
            self._flush()
            self._waiting_ns = event.t_ns
        data = event.data
        match event.kind:
            case TraceKind.TAG | TraceKind.STATE:
                if not self._is_secret(event):
                    self._add_value(event)
            case TraceKind.FRAME:
                self._add_frame(event)
            case TraceKind.FAULT:
                fault = {"id": event.where, "name": str(data.get("name", "")), "target": str(data.get("target") or "")}
                self._write("/faults", FAULT, event.t_ns, fault | {"on": bool(data.get("on"))})
                self._log(event, WARNING if data.get("on") else INFO)
            case TraceKind.REFUSED:
                file, _, line = str(data.get("place") or "").rpartition(":")
                self._log(event, ERROR, file, int(line) if file and line.isdecimal() else 0)
            case TraceKind.STEP:
                self._log(event, ERROR if data.get("verdict") == "failed" else INFO)
            case _:
                self._log(event, INFO)

    def finish(self) -> None:
        """Write what is still waiting, and the requests that had no reply by the end."""
        self._flush()
        self._add_exchanges(self._decoder.finish())

    def _add_value(self, event: TraceEvent) -> None:
        topic, name = _place(event)
        value = event.data.get("value")
        tag = self._tag(topic, name)
        words = dict(tag.values) if tag is not None else self._words.get(event.where, {})
        reason = str(event.data.get("reason") or "")
        message = group_value(
            value, self._kinds[topic][name], quality=str(event.data.get("quality") or ""),
            reason="" if reason == "none" else reason, unit=tag.unit if tag is not None else "",
            name=words.get(value, "") if isinstance(value, int) else "",
        )  # fmt: skip
        waiting = self._waiting.setdefault(topic, {})
        if name in waiting:  # it changed twice at the same time
            self._write(topic, self._schemas[topic], event.t_ns, waiting)
            waiting = self._waiting[topic] = {}
        waiting[name] = message

    def _add_frame(self, event: TraceEvent) -> None:
        decoded = self._decoder.decode(event)
        item = frame_item(event.data)
        if item is not None:
            message = frame_message(event.where, direction_of(event.data), item, decoded.text)
            self._write("/frames", FRAME, event.t_ns, message)
        self._add_exchanges(decoded.exchanges)

    def _add_exchanges(self, exchanges: Iterable[DecodedExchange]) -> None:
        for exchange in exchanges:
            self._write("/exchanges", EXCHANGE, exchange.t_ns, _exchange_message(exchange))

    def _log(self, event: TraceEvent, level: int, file: str = "", line: int = 0) -> None:
        at_ns = max(0, event.t_ns + self._start_ns)
        text = self._decoder.decode(event).text
        message = log_message(at_ns, level, f"{event.kind.value} {event.where}", text, file, line)
        self._write("/log", LOG, event.t_ns, message)

    def _flush(self) -> None:
        for topic, message in self._waiting.items():
            self._write(topic, self._schemas[topic], self._waiting_ns, message)
        self._waiting.clear()

    def _write(self, topic: str, schema: Schema, t_ns: int, message: Mapping[str, Any]) -> None:
        self._file.message(topic, schema, t_ns + self._start_ns, message)

    def _is_secret(self, event: TraceEvent) -> bool:
        tag = self._tags.get(event.where)
        return tag is not None and tag.secret

    def _tag(self, topic: str, name: str) -> Tag | None:
        device = topic.removeprefix(_GROUPED[TraceKind.TAG])
        return None if device == topic else self._tags.get(f"{device}.{name}")


def _place(event: TraceEvent) -> tuple[str, str]:
    """Return the topic of a value, and its name there."""
    group, _, name = event.where.rpartition(".")
    return f"{_GROUPED[event.kind]}{group or name}", name


def _words(description: TraceAbout | None) -> dict[str, dict[int, str]]:
    """Return the names of the values of each PROGRAM.VARIABLE."""
    programs = description.programs if description is not None else {}
    return {
        f"{program}.{name}": {int(value): word for value, word in variable.words.items() if value.isdecimal()}
        for program, about in programs.items()
        for name, variable in about.variables.items()
    }


def _exchange_message(e: DecodedExchange) -> dict[str, Any]:
    """Return a message of the schema `EXCHANGE`. The bytes of an exchange with a secret tag are left out."""
    found: dict[str, Any] = {
        "bus": e.bus,
        "device": e.device,
        "unit": e.unit,
        "service": e.service,
        "problem": e.problem,
    }
    if e.spans:
        found |= {"table": e.spans[0].table, "address": e.spans[0].address, "count": e.count}
    if e.latency_ns is not None:
        found["latency_ms"] = e.latency_ns / 1e6
    if not e.secrets:
        found |= {"request": e.request.hex(), "reply": e.reply.hex()}
    return found | {"text": e.text, "reply_text": e.reply_text}
