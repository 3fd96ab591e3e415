"""Probes: registers of a third-party controller that a scenario polls with the gateway's Modbus client, apart from the tags."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

from fieldtwin.gateway.connections.os_connector import OsConnector
from fieldtwin.gateway.core.clock import NS_PER_S, Clock
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.connection import Connector
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.values import TagValue
from fieldtwin.gateway.devices.config import BusConfig, DeviceConfig
from fieldtwin.gateway.devices.register_device import RegisterDriver
from fieldtwin.gateway.runtime.buses.modbus.modbus_bus import ModbusBus
from fieldtwin.gateway.runtime.tags import TagTable
from fieldtwin.results.trace import TraceEvent, TraceKind
from fieldtwin.scenarios.bench import TagReading
from fieldtwin.scenarios.language.probe_form import ScenarioProbe

MOST_EVENTS = 50_000


class Probes:
    """All probes of a scenario. ``await run()`` polls them until cancelled; `reading` returns the latest values, and `changes`
    the changes since its last call.

    `served` gives the endpoint of each server of the system's own gateway that a probe polls, by name.
    """

    def __init__(
        self,
        probes: Sequence[ScenarioProbe],
        clock: Clock,
        served: Callable[[str], Endpoint],
        connector: Connector | None = None,
    ) -> None:
        self.names = [name for probe in probes for name in probe.names]
        self._clock = clock
        self._tags = TagTable(clock)
        self._tags.subscribe(self._put)
        self._updates: dict[str, int] = {}
        self.on_change: Callable[[TraceKind, str, dict[str, Any]], None] | None = None
        """Called with each change as it occurs; if None, changes are kept for `changes`."""
        self._events: deque[tuple[int, str, dict[str, Any]]] = deque(maxlen=MOST_EVENTS)
        self._buses = [self._bus(probe, served, connector or OsConnector()) for probe in probes]

    def _bus(self, probe: ScenarioProbe, served: Callable[[str], Endpoint], connector: Connector) -> ModbusBus:
        every_ms = max(1, round(probe.every_s * 1000))
        groups = dict.fromkeys((tag.poll for tag in probe.profile.tags.values()), every_ms)
        stale_ms = max(3 * every_ms, round(2 * probe.timeout_s * 1000))
        config = DeviceConfig(
            probe.name, probe.profile, probe.name, probe.unit, poll=groups, stale_after_ms=stale_ms, backoff_limit_s=2.0
        )
        self._tags.declare(probe.names, stale_ms)
        endpoint = probe.endpoint or served(probe.serve)
        bus = BusConfig(probe.name, endpoint, probe.timeout_s, 0)
        driver = RegisterDriver(config, self._tags)
        return ModbusBus(bus, [driver], connector, self._clock, self._tags, lambda driver: None)

    async def run(self) -> None:
        async with Nursery() as nursery:
            for bus in self._buses:
                nursery.start(bus.run(), f"probe {bus.config.name}")
            await nursery.wait()

    def reading(self, name: str) -> TagReading | None:
        """Return the current reading; None if the register was never read."""
        now_ns = self._clock.monotonic_ns()
        seen = self._tags.current(name, now_ns)
        if seen.value is None:
            return None
        value = seen.value.hex() if isinstance(seen.value, bytes) else seen.value
        return TagReading(
            value,
            seen.quality.name.lower(),
            seen.reason.name.lower(),
            (now_ns - seen.t_ns) / NS_PER_S,
            self._updates.get(name, 0),
        )

    def why_unknown(self, name: str) -> str:
        """Return why a probe's register has no value: the endpoint that did not answer, and its error. Empty for other names."""
        bus = next((one for one in self._buses if one.config.name == name.partition(".")[0]), None)
        if bus is None or name not in self.names:
            return ""
        error = bus.error or next((device.error for device in bus.devices if device.error), "")
        return f"the probe {bus.config.name} at {bus.config.endpoint}: {error or 'no answer yet'}"

    def changes(self, start_ns: int) -> list[TraceEvent]:
        """Return the TAG events since the last call, in ns since `start_ns`."""
        events = [TraceEvent(t_ns - start_ns, TraceKind.TAG, name, data) for t_ns, name, data in self._events]
        self._events.clear()
        return events

    def _put(self, name: str, value: TagValue) -> None:
        self._updates[name] = self._updates.get(name, 0) + 1
        shown = value.value.hex() if isinstance(value.value, bytes) else value.value
        data = {"value": shown, "quality": value.quality.name.lower(), "reason": value.reason.name.lower()}
        if self.on_change is not None:
            self.on_change(TraceKind.TAG, name, data)
        else:
            self._events.append((self._clock.monotonic_ns(), name, data))
