"""A run's metrics for monitoring: the latest statuses of gateway and PLC.

They contain values and names of those tags only that the system file exports, because others may be confidential, and because a
plant with 100,000 tags then has no more series than one with ten. Each device has a few series, up to `MOST_DEVICES` devices; the
rest is counted as left out. This module sends no requests: its caller passes statuses that the run polls in any case.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from itertools import islice
from typing import Any

from msgspec import UnsetType

from fieldtwin.__about__ import __version__
from fieldtwin.gateway.core.values import Quality, Reason
from fieldtwin.gateway.protocols.canopen.sdo.channel import SdoCounters as CanopenCounters
from fieldtwin.gateway.protocols.modbus.client_counters import ClientCounters
from fieldtwin.gateway.runtime.gateway_status import FrontStatus, GatewayStatus, TagStatus
from fieldtwin.plc.status import PlcStatus, ScanStatus, Spread, TaskStatus
from fieldtwin.service import metric_families as metric
from fieldtwin.service.exposition import Family
from fieldtwin.service.metric_families import Metric
from fieldtwin.twin.site.exported_tags import ExportedTag
from fieldtwin.twin.thread.status import PlantThreadStatus

MOST_DEVICES = 1000
"""Devices that have series; the others are only counted."""

MOST_NAMED = 256
"""The largest number of buses that have series; the same limit applies to servers, bridges and tasks."""

OLDEST_STATUS_S = 2.0
"""The age in seconds at which a status of the gateway is too old to call a value good. Usually a status is at most half a second
old; it is older if a process of the run does not answer.
"""

STATES = ("ready", "running", "paused", "waiting", "stopped")
"""The states of a task (`ScanStatus.state`)."""

ALWAYS = {"modbus": ("missed_polls", *asdict(ClientCounters())), "canopen": tuple(asdict(CanopenCounters()))}
"""Counters that a bus exports before they first count, because a rate needs the 0."""


@dataclass(frozen=True, slots=True)
class RunState:
    """The latest known state of a run.

    A status is None while its process does not answer. `children`: whether each child process runs. `asked_ago_s`: seconds since
    the last answer of the gateway or the PLC, whichever answered earlier; `gateway_ago_s`: since that of the gateway.
    `exported_tags`: the tags whose values are exported.
    """

    system: str
    mode: str
    uptime_s: float
    gateway: GatewayStatus | None
    plc: PlcStatus | None
    children: Mapping[str, bool]
    asked_ago_s: float
    thread: PlantThreadStatus | None = None
    gateway_ago_s: float = 0.0
    exported_tags: tuple[ExportedTag, ...] = ()


class Page:
    """The metrics page: its families, in the order in which they were first used."""

    def __init__(self) -> None:
        self.families: dict[str, Family] = {}

    def family(self, declared: Metric) -> Family:
        """Return the family of a metric, empty at its first use."""
        return self.families.setdefault(declared.name, Family(declared.name, declared.kind, declared.help))


def families(seen: RunState) -> list[Family]:
    """Return all metrics of `seen`. If a process does not answer, its metrics are left out, and `fieldtwin_up` is 0."""
    page = Page()
    page.family(metric.INFO).add(1, version=__version__, system=seen.system, mode=seen.mode)
    page.family(metric.RUN_SECONDS).add(seen.uptime_s)
    page.family(metric.STATUS_AGE).add(seen.asked_ago_s)
    up = page.family(metric.UP)
    for name, lives in seen.children.items():
        answers = {"gateway": seen.gateway is not None, "plc": seen.plc is not None}.get(name, True)
        up.add(int(lives and answers), process=name)
    if seen.gateway is not None:
        for part in (_buses, _devices, _tags, _writes, _mailboxes, _clients, _watchers):
            part(page, seen.gateway)
        _values(page, seen, seen.gateway)
    if seen.plc is not None:
        _plc(page, seen.plc)
    if seen.thread is not None:
        page.family(metric.THREAD_DROPPED).add(seen.thread.dropped)
    return list(page.families.values())


def _buses(page: Page, gateway: GatewayStatus) -> None:
    connected = page.family(metric.BUS_CONNECTED)
    opens = page.family(metric.BUS_OPENS)
    events = page.family(metric.BUS_EVENTS)
    latency = page.family(metric.BUS_LATENCY)
    late = page.family(metric.BUS_NOT_PRODUCED)
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
    online = page.family(metric.DEVICE_ONLINE)
    wrong = page.family(metric.DEVICE_WRONG)
    polls = page.family(metric.DEVICE_POLLS)
    errors = page.family(metric.DEVICE_ERRORS)
    boots = page.family(metric.DEVICE_BOOTS)
    emcys = page.family(metric.DEVICE_EMCYS)
    pdos = page.family(metric.DEVICE_PDOS)
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
    page.family(metric.DEVICES).add(len(devices))
    page.family(metric.DEVICES_ONLINE).add(sum(d.online for d in devices.values()))
    page.family(metric.DEVICES_LEFT_OUT).add(max(0, len(devices) - MOST_DEVICES))


def _tags(page: Page, gateway: GatewayStatus) -> None:
    qualities = Counter(tag.quality for tag in gateway.tags.values())
    counted = page.family(metric.TAGS)
    for quality in Quality:
        counted.add(qualities[str(quality)], quality=str(quality))
    ages = [tag.age_s for tag in gateway.tags.values() if tag.age_s is not None]
    page.family(metric.TAGS_OLDEST).add(max(ages, default=None))
    page.family(metric.PUBLISHED).add(gateway.published)
    page.family(metric.LOGGED).add(gateway.logged)
    page.family(metric.LOG_DROPPED).add(gateway.log_dropped)
    if not isinstance(gateway.config, UnsetType):
        page.family(metric.RELOADS).add(gateway.config.reloads)
    page.family(metric.STORE_OK).add(int(not gateway.store_error))


def _values(page: Page, seen: RunState, gateway: GatewayStatus) -> None:
    """Add the values of the exported tags. A tag whose value is not good has no value here: a scrape without the sample ends the
    series at once, whereas NaN would be a sample that spoils every average and maximum over time.
    """
    values, good = page.family(metric.TAG_VALUE), page.family(metric.TAG_GOOD)
    problems = page.family(metric.TAG_PROBLEM)
    recent = seen.gateway_ago_s <= OLDEST_STATUS_S
    for tag in seen.exported_tags:
        status = gateway.tags.get(tag.name)
        value = status.value if status is not None and recent and status.quality == str(Quality.GOOD) else None
        number = value if isinstance(value, int | float) else None
        values.add(number, device=tag.device, tag=tag.tag, unit=tag.unit)
        good.add(int(number is not None), device=tag.device, tag=tag.tag)
        if number is None:
            problems.add(1, device=tag.device, tag=tag.tag, reason=_problem(status, recent))


def _problem(status: TagStatus | None, recent: bool) -> str:
    """Return the reason why a tag is not good, in the words of `fieldtwin explain`. A status that is not recent says nothing
    about the present value.
    """
    if not recent:
        return str(Reason.GATEWAY_DEAD)
    return str(Reason.NEVER_READ) if status is None else status.reason


def _writes(page: Page, gateway: GatewayStatus) -> None:
    writes = gateway.writes
    page.family(metric.WRITES_ALLOWED).add(int(writes.allowed))
    page.family(metric.OUTPUTS_SAFE).add(int(writes.safe))
    counted = page.family(metric.WRITES)
    for result in ("done", "failed", "refused", "repeated"):
        counted.add(getattr(writes, result), result=result)
    held = [o for o in gateway.outputs if o.wanted is not None and o.wanted != o.held]
    page.family(metric.OUTPUTS_PENDING).add(len(held))
    page.family(metric.PLC_ALIVE).add(int(gateway.plc.alive))
    page.family(metric.PLC_LOSSES).add(gateway.plc.losses)


def _mailboxes(page: Page, gateway: GatewayStatus) -> None:
    queued = page.family(metric.MAILBOX_QUEUED)
    counted = page.family(metric.MAILBOX_MESSAGES)
    for name, box in _some(gateway.mailboxes):
        queued.add(box.queued, device=name)
        for what in ("received", "sent", "taken", "dropped", "waits", "commands_refused"):
            counted.add(getattr(box, what), device=name, what=what)


def _clients(page: Page, gateway: GatewayStatus) -> None:
    """Add the counters of requests that clients sent to the gateway's servers and bridges."""
    counted = page.family(metric.SERVER_EVENTS)
    fronts: list[tuple[str, Mapping[str, FrontStatus]]] = [("serve", gateway.serve), ("bridge", gateway.bridge)]
    for kind, servers in fronts:
        for name, server in _some(servers):
            for event, count in server.counters.items():
                counted.add(count, kind=kind, name=name, event=event)


def _watchers(page: Page, gateway: GatewayStatus) -> None:
    """Add the number of devices with each problem, so that an alert need not match texts."""
    page.family(metric.DEVICES_WRONG).add(sum(bool(d.identity_error) for d in gateway.devices.values()))


def _plc(page: Page, plc: PlcStatus) -> None:
    tasks: dict[str, ScanStatus] = dict(_some(plc.tasks or {"main": plc}))
    counts: list[tuple[Metric, Callable[[ScanStatus], int]]] = [
        (metric.PLC_SCANS, lambda t: t.scans),
        (metric.PLC_MISSED_PERIODS, lambda t: t.missed_periods),
        (metric.PLC_OVERRUNS, lambda t: t.overruns),
    ]
    for declared, count_of in counts:
        counted = page.family(declared)
        for task, status in tasks.items():
            counted.add(count_of(status), task=task)
    period = page.family(metric.PLC_PERIOD)
    for task, status in tasks.items():
        if not (isinstance(status, TaskStatus) and status.single):  # a task that an event starts has no period
            period.add(status.cycle_ms / 1e3, task=task)
    spreads: list[tuple[Metric, Callable[[ScanStatus], Spread]]] = [
        (metric.PLC_LATENESS, lambda t: t.lateness_us),
        (metric.PLC_SCAN, lambda t: t.duration_us),
    ]
    for declared, spread_of in spreads:
        gauge = page.family(declared)
        for task, status in tasks.items():
            for quantile, part in (("0.5", "p50"), ("0.99", "p99"), ("0.999", "p999"), ("1", "max")):
                gauge.add(spread_of(status)[part] / 1e6, task=task, quantile=quantile)
    running = page.family(metric.PLC_RUNNING)
    for task, status in tasks.items():
        running.add(int(status.state == "running"), task=task)
    states = page.family(metric.PLC_STATE)
    for task, status in tasks.items():
        for state in STATES:
            states.add(int(status.state == state), task=task, state=state)
    page.family(metric.PLC_PROGRAMS_WAITING).add(len(plc.waiting))
    page.family(metric.PLC_RESTARTS).add(plc.restarts)
    page.family(metric.PLC_CHANGES).add(plc.changes.count)
    page.family(metric.PLC_FORCES).add(len(plc.forces))
    counted = page.family(metric.PLC_EVENTS)
    for event, count in plc.counters.items():
        counted.add(count, event=event)


def _some(named: Mapping[str, Any]) -> list[tuple[str, Any]]:
    return list(islice(named.items(), MOST_NAMED))


def _set(number: int | UnsetType) -> int | None:
    """Return a counter as a sample; None, which leaves the sample out, for a device or bus that does not have this counter."""
    return None if isinstance(number, UnsetType) else number
