"""Events between two snapshots of a run, for a log that programs read.

This module performs no I/O. Events never contain values of tags, like all texts of the service.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum

from fieldtwin.gateway.runtime.gateway_status import BusStatus, DeviceStatus, GatewayStatus
from fieldtwin.plc.status import PlcStatus
from fieldtwin.service.metrics import RunState
from fieldtwin.twin.thread.status import PlantThreadStatus


class Priority(IntEnum):
    """The syslog priorities (RFC 5424, 6.2.1) that are used here."""

    ERROR = 3
    WARNING = 4
    NOTICE = 5
    INFO = 6


@dataclass(frozen=True, slots=True)
class ServiceEvent:
    """An event. `fields` are short names with text or numbers: device, bus, error..."""

    priority: Priority
    name: str
    message: str
    fields: Mapping[str, str | int | float] = field(default_factory=dict)


def changes(before: RunState | None, now: RunState) -> list[ServiceEvent]:
    """Return the events between two snapshots. Without an earlier snapshot, every fault that is present is an event."""
    return [
        *_children(before, now),
        *_buses(_buses_of(before), _buses_of(now)),
        *_devices(_devices_of(before), _devices_of(now)),
        *_plc(before.plc if before else None, now.plc),
        *_reloaded(before.gateway if before else None, now.gateway),
        *_replaced(before.plc if before else None, now.plc),
        *_thread(before.thread if before else None, now.thread),
        *_refused(before.gateway if before else None, now.gateway),
        *_dropped(before.gateway if before else None, now.gateway),
    ]


def _buses_of(seen: RunState | None) -> Mapping[str, BusStatus]:
    return seen.gateway.buses if seen is not None and seen.gateway is not None else {}


def _devices_of(seen: RunState | None) -> Mapping[str, DeviceStatus]:
    return seen.gateway.devices if seen is not None and seen.gateway is not None else {}


def _children(before: RunState | None, now: RunState) -> list[ServiceEvent]:
    found = []
    for name, lives in now.children.items():
        if not lives and (before is None or before.children.get(name, True)):
            found.append(ServiceEvent(Priority.ERROR, "process_ended", f"the {name} process ended", {"process": name}))
    return found


def _buses(before: Mapping[str, BusStatus], now: Mapping[str, BusStatus]) -> list[ServiceEvent]:
    found = []
    for name, bus in now.items():
        was = before.get(name)
        if bus.connected and (was is None or not was.connected):
            found.append(ServiceEvent(Priority.INFO, "bus_open", f"{name}: open", {"bus": name}))
        elif bus.error and (was is None or was.error != bus.error):
            text = f"{name}: {bus.error}"
            found.append(ServiceEvent(Priority.ERROR, "bus_closed", text, {"bus": name, "error": bus.error}))
    return found


def _devices(before: Mapping[str, DeviceStatus], now: Mapping[str, DeviceStatus]) -> list[ServiceEvent]:
    found = []
    for name, device in now.items():
        was = before.get(name)
        fields = {"device": name, "bus": device.bus}
        if device.online and (was is None or not was.online):
            found.append(ServiceEvent(Priority.NOTICE, "device_online", f"{name}: answers", fields))
        elif not device.online and device.error and (was is None or was.online or was.error != device.error):
            named = {**fields, "error": device.error}
            found.append(ServiceEvent(Priority.WARNING, "device_offline", f"{name}: {device.error}", named))
        if device.unstarted and (was is None or not was.unstarted):
            found.append(ServiceEvent(Priority.WARNING, "device_not_started", f"{name}: {device.unstarted}", fields))
        codes = device.emcy or []
        if codes and codes != ((was.emcy if was is not None else None) or []):
            named = {**fields, "emcy": " ".join(codes)}
            found.append(ServiceEvent(Priority.WARNING, "device_emcy", f"{name}: emergency {' '.join(codes)}", named))
    return found


def _plc(before: PlcStatus | None, now: PlcStatus | None) -> list[ServiceEvent]:
    if now is None:
        return []
    if before is not None and (now.state, now.error) == (before.state, before.error):
        return []
    healthy = now.state == "running" or (now.state == "waiting" and not now.error)
    priority = Priority.NOTICE if healthy else Priority.ERROR
    why = now.error or "; ".join(f"program {program} for {start.reason}" for program, start in now.waiting.items())
    text = f"PLC: {now.state}" + (f": {why}" if why else "")
    return [ServiceEvent(priority, "plc_state", text, {"state": now.state, "error": now.error})]


def _reloaded(before: GatewayStatus | None, now: GatewayStatus | None) -> list[ServiceEvent]:
    """Return the event of a reload of the files, regardless of the user or program that requested it."""
    if before is None or now is None or not before.config or not now.config:
        return []
    if before.config.reloads == now.config.reloads:
        return []
    text = "reloaded: " + "; ".join(now.config.changed)
    return [ServiceEvent(Priority.NOTICE, "reloaded", text, {"hash": now.config.hash})]


def _replaced(before: PlcStatus | None, now: PlcStatus | None) -> list[ServiceEvent]:
    """Return the event of programs that were replaced while they ran."""
    if before is None or now is None or before.changes.count == now.changes.count:
        return []
    count = len(now.changes.last)
    return [ServiceEvent(Priority.NOTICE, "reloaded", "reloaded: " + "; ".join(now.changes.last), {"count": count})]


def _thread(before: PlantThreadStatus | None, now: PlantThreadStatus | None) -> list[ServiceEvent]:
    """Return the events of the digital thread: the beginning and end of problems with its carrier or its log's storage."""
    if now is None:
        return []
    found = []
    for key, what, text, was in (
        ("trouble", "thread", now.trouble, before.trouble if before else ""),
        ("store_trouble", "store of the thread", now.store_trouble, before.store_trouble if before else ""),
    ):
        if text != was:
            priority = Priority.WARNING if text else Priority.NOTICE
            found.append(ServiceEvent(priority, f"thread_{key}", f"{what}: {text or 'recovered'}", {"error": text}))
    return found


def _refused(before: GatewayStatus | None, now: GatewayStatus | None) -> list[ServiceEvent]:
    """Return events for writes that did not reach their device. The fields of the events contain no values."""
    last = max((e.number for e in (before.refusals.entries if before is not None else [])), default=0)
    found = []
    for entry in now.refusals.entries if now is not None else []:
        if entry.number > last:
            priority = Priority.WARNING if entry.fault else Priority.NOTICE
            named = {"tag": entry.tag, "cause": entry.cause, "by": entry.by, "place": entry.place}
            text = f"{entry.tag}: a write did not reach the device ({entry.cause})"
            found.append(ServiceEvent(priority, "output_refused", text, named))
    return found


def _dropped(before: GatewayStatus | None, now: GatewayStatus | None) -> list[ServiceEvent]:
    if now is None:
        return []
    lost = now.log_dropped - (before.log_dropped if before is not None else 0)
    found = []
    if lost > 0:
        text = f"the exchange log lost {lost} entries"
        found.append(ServiceEvent(Priority.WARNING, "log_dropped", text, {"count": lost}))
    if now.writes.safe and not (before is not None and before.writes.safe):
        found.append(ServiceEvent(Priority.WARNING, "outputs_safe", "outputs are at their safe values"))
    return found
