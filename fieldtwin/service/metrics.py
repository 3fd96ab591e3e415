"""A run's metrics for monitoring: the latest statuses of gateway and PLC.

They contain neither values nor names of tags, because these may be confidential, and because a plant with 100,000 tags then
has no more series than one with ten. Each device has a few series, up to `MOST_DEVICES` devices; the rest is counted as left
out. This module sends no requests: its caller passes statuses that the run polls in any case.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from itertools import islice
from typing import Any

from msgspec import UnsetType

from fieldtwin.__about__ import __version__
from fieldtwin.gateway.core.values import Quality
from fieldtwin.gateway.protocols.canopen.sdo.channel import SdoCounters as CanopenCounters
from fieldtwin.gateway.protocols.modbus.client_counters import ClientCounters
from fieldtwin.gateway.runtime.gateway_status import FrontStatus, GatewayStatus
from fieldtwin.plc.status import PlcStatus, ScanStatus, Spread
from fieldtwin.service.exposition import Family
from fieldtwin.twin.thread.status import PlantThreadStatus

MOST_DEVICES = 1000
"""Devices that have series; the others are only counted."""

MOST_NAMED = 256
"""The largest number of buses that have series; the same limit applies to servers, bridges and tasks."""

ALWAYS = {"modbus": ("missed_polls", *asdict(ClientCounters())), "canopen": tuple(asdict(CanopenCounters()))}
"""Counters that a bus exports before they first count, because a rate needs the 0."""


@dataclass(frozen=True, slots=True)
class RunState:
    """The latest known state of a run.

    A status is None while its process does not answer. `children`: whether each child process runs. `asked_ago_s`: seconds since
    the last answer of the gateway or the PLC, whichever answered earlier.
    """

    system: str
    mode: str
    uptime_s: float
    gateway: GatewayStatus | None
    plc: PlcStatus | None
    children: Mapping[str, bool]
    asked_ago_s: float
    thread: PlantThreadStatus | None = None


class Page:
    """The metrics page: its families, in the order in which they were first used."""

    def __init__(self) -> None:
        self.families: dict[str, Family] = {}

    def counter(self, name: str, help: str) -> Family:
        return self._family(Family(f"fieldtwin_{name}_total", "counter", help))

    def gauge(self, name: str, help: str) -> Family:
        return self._family(Family(f"fieldtwin_{name}", "gauge", help))

    def histogram(self, name: str, help: str) -> Family:
        return self._family(Family(f"fieldtwin_{name}", "histogram", help))

    def _family(self, family: Family) -> Family:
        return self.families.setdefault(family.name, family)


def families(seen: RunState) -> list[Family]:
    """Return all metrics of `seen`. If a process does not answer, its metrics are left out, and `fieldtwin_up` is 0."""
    page = Page()
    page.gauge("info", "Version, system, and whether it is a plant or its prototype.").add(
        1, version=__version__, system=seen.system, mode=seen.mode
    )
    page.gauge("run_seconds", "Duration of this run.").add(seen.uptime_s)
    page.gauge("status_age_seconds", "Age of the statuses from which these metrics come.").add(seen.asked_ago_s)
    up = page.gauge("up", "Whether a process of the run is alive and, for gateway and PLC, answers.")
    for name, lives in seen.children.items():
        answers = {"gateway": seen.gateway is not None, "plc": seen.plc is not None}.get(name, True)
        up.add(int(lives and answers), process=name)
    if seen.gateway is not None:
        for part in (_buses, _devices, _tags, _writes, _mailboxes, _clients, _watchers):
            part(page, seen.gateway)
    if seen.plc is not None:
        _plc(page, seen.plc)
    if seen.thread is not None:
        page.counter("thread_dropped", "Events that the digital thread's log lost.").add(seen.thread.dropped)
    return list(page.families.values())


def _buses(page: Page, gateway: GatewayStatus) -> None:
    connected = page.gauge("bus_connected", "Whether the bus's connection is open.")
    opens = page.counter(
        "bus_opens", "How often the connection was opened; more than once means that it was lost and recovered."
    )
    events = page.counter(
        "bus_events",
        "Counters of the gateway on a bus: requests, replies, timeouts, CRC errors, frames, PDOs... by event.",
    )
    latency = page.histogram(
        "bus_latency_seconds", "Response times: from request to reply (Modbus), and whole SDO transfers (CANopen)."
    )
    late = page.counter("bus_not_produced", "SYNC, TIME and repeated RPDOs that could not be sent in their period.")
    for name, bus in _some(gateway.buses):
        connected.add(int(bus.connected), bus=name)
        opens.add(bus.opens, bus=name)
        is_can = not isinstance(bus.not_produced, UnsetType)
        for event, count in (dict.fromkeys(ALWAYS["canopen" if is_can else "modbus"], 0) | bus.counters).items():
            events.add(count, bus=name, event=event)
        bounds = [ms / 1000 for ms in bus.latency.bounds_ms]
        latency.add_histogram(bounds, bus.latency.counts, bus.latency.total_s, bus=name)
        late.add(_set(bus.not_produced), bus=name)


def _devices(page: Page, gateway: GatewayStatus) -> None:
    online = page.gauge("device_online", "Whether a device answers and has the expected identity.")
    wrong = page.gauge("device_wrong", "Whether the device that answers differs from the one in the system file.")
    polls = page.counter("device_polls", "Polls of a device.")
    errors = page.counter("device_errors", "Polls that failed, and PDOs that were malformed.")
    boots = page.counter(
        "device_boots", "Boot-ups received from a CANopen node; more than expected means that the device restarts."
    )
    emcys = page.counter("device_emcys", "Emergency messages of a CANopen node.")
    pdos = page.counter("device_pdos", "Process data frames, by direction from the gateway's view.")
    devices = gateway.devices
    for name, device in islice(devices.items(), MOST_DEVICES):
        labels = {"device": name, "bus": device.bus}
        online.add(int(device.online), **labels)
        wrong.add(int(bool(device.identity_error)), **labels)
        polls.add(device.polls, **labels)
        errors.add(device.errors, **labels)
        boots.add(_set(device.boots), **labels)
        emcys.add(_set(device.emcys), **labels)
        if not isinstance(device.tpdos, UnsetType):
            pdos.add(sum(t.frames for t in device.tpdos.values()), **labels, direction="in")
            pdos.add(_set(device.rpdos_sent), **labels, direction="out")
    page.gauge("devices", "Devices of the system.").add(len(devices))
    page.gauge("devices_online", "Devices that answer.").add(sum(d.online for d in devices.values()))
    page.gauge("devices_left_out", "Devices above the limit, which have no series.").add(
        max(0, len(devices) - MOST_DEVICES)
    )


def _tags(page: Page, gateway: GatewayStatus) -> None:
    qualities = Counter(tag.quality for tag in gateway.tags.values())
    counted = page.gauge("tags", "Tags by their present quality.")
    for quality in Quality:
        counted.add(qualities[str(quality)], quality=str(quality))
    ages = [tag.age_s for tag in gateway.tags.values() if tag.age_s is not None]
    page.gauge("tags_oldest_seconds", "Age of the oldest value.").add(max(ages, default=None))
    page.counter("published", "Values published.").add(gateway.published)
    page.counter("logged", "Entries of the exchange log.").add(gateway.logged)
    page.counter("log_dropped", "Entries that the exchange log lost.").add(gateway.log_dropped)
    if not isinstance(gateway.config, UnsetType):
        page.counter("reloads", "Times that a changed configuration was applied.").add(gateway.config.reloads)
    page.gauge("store_ok", "Whether the last write of the log to disk succeeded.").add(int(not gateway.store_error))


def _writes(page: Page, gateway: GatewayStatus) -> None:
    writes = gateway.writes
    page.gauge("writes_allowed", "Whether this run may write.").add(int(writes.allowed))
    page.gauge("outputs_safe", "Whether the outputs are at their safe values because the PLC was lost.").add(
        int(writes.safe)
    )
    counted = page.counter("writes", "Writes of outputs, by result; `repeated` ones are periodic repetitions.")
    for result in ("done", "failed", "refused", "repeated"):
        counted.add(getattr(writes, result), result=result)
    held = [o for o in gateway.outputs if o.wanted is not None and o.wanted != o.held]
    page.gauge("outputs_pending", "Outputs whose device does not hold the commanded value yet.").add(len(held))
    page.gauge("plc_alive", "Whether the gateway receives the PLC's heartbeat.").add(int(gateway.plc.alive))
    page.counter("plc_losses", "How often the gateway lost the PLC.").add(gateway.plc.losses)


def _mailboxes(page: Page, gateway: GatewayStatus) -> None:
    queued = page.gauge("mailbox_queued", "Queued messages of a transmitter.")
    counted = page.counter("mailbox_messages", "Messages of a transmitter, by result.")
    for name, box in _some(gateway.mailboxes):
        queued.add(box.queued, device=name)
        for what in ("received", "sent", "taken", "dropped", "waits", "commands_refused"):
            counted.add(getattr(box, what), device=name, what=what)


def _clients(page: Page, gateway: GatewayStatus) -> None:
    """Add the counters of requests that clients sent to the gateway's servers and bridges."""
    counted = page.counter("server_events", "Counters of a server or bridge, by event.")
    fronts: list[tuple[str, Mapping[str, FrontStatus]]] = [("serve", gateway.serve), ("bridge", gateway.bridge)]
    for kind, servers in fronts:
        for name, server in _some(servers):
            for event, count in server.counters.items():
                counted.add(count, kind=kind, name=name, event=event)


def _watchers(page: Page, gateway: GatewayStatus) -> None:
    """Add the number of devices with each problem, so that an alert need not match texts."""
    page.gauge("devices_wrong", "Devices that differ from those in the system file.").add(
        sum(bool(d.identity_error) for d in gateway.devices.values())
    )


def _plc(page: Page, plc: PlcStatus) -> None:
    per_task: list[tuple[str, str, Callable[[ScanStatus], Any]]] = [
        ("scans", "Scans of a task.", lambda t: t.scans),
        ("missed_periods", "Periods in which a task's scan did not start.", lambda t: t.missed_periods),
        ("overruns", "Scans that took longer than their period.", lambda t: t.overruns),
    ]
    tasks: dict[str, ScanStatus] = dict(_some(plc.tasks or {"main": plc}))
    for name, text, of in per_task:
        counted = page.counter(f"plc_{name}", text)
        for task, status in tasks.items():
            counted.add(of(status), task=task)
    spreads: list[tuple[str, str, Callable[[ScanStatus], Spread]]] = [
        (
            "plc_lateness_seconds",
            "Start delay of scans since the start, by quantile; 1 is the maximum.",
            lambda t: t.lateness_us,
        ),
        (
            "plc_scan_seconds",
            "Duration of scans since the start, by quantile; 1 is the maximum.",
            lambda t: t.duration_us,
        ),
    ]
    for name, text, spread_of in spreads:
        gauge = page.gauge(name, text)
        for task, status in tasks.items():
            for quantile, part in (("0.5", "p50"), ("0.99", "p99"), ("0.999", "p999"), ("1", "max")):
                gauge.add(spread_of(status)[part] / 1e6, task=task, quantile=quantile)
    running = page.gauge("plc_running", "Whether a task runs; 0 is stopped or failed.")
    for task, status in tasks.items():
        running.add(int(status.state == "running"), task=task)
    page.gauge("plc_programs_waiting", "Programs that wait for their inputs and have not started.").add(
        len(plc.waiting)
    )
    page.counter("plc_restarts", "Restarts of the PLC's program after a failure.").add(plc.restarts)
    page.gauge("plc_forces", "Variables that are forced.").add(len(plc.forces))
    counted = page.counter("plc_events", "Counters of the PLC's process image and messages, by event.")
    for event, count in plc.counters.items():
        counted.add(count, event=event)


def _some(named: Mapping[str, Any]) -> list[tuple[str, Any]]:
    return list(islice(named.items(), MOST_NAMED))


def _set(number: int | UnsetType) -> int | None:
    """Return a counter as a sample; None, which leaves the sample out, for a device or bus that does not have this counter."""
    return None if isinstance(number, UnsetType) else number
