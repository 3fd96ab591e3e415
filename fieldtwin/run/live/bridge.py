"""A standalone bridge: one bus and one listening endpoint, until it is stopped. `fieldtwin bridge` runs it.

It uses the same parts as a system's gateway, but it has no devices to poll and no PLC that takes precedence.
"""

from __future__ import annotations

import asyncio
import os
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import msgspec

from fieldtwin.gateway.connections.os_connector import OsConnector
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.concurrency.stop_signal import stop_signal
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.devices.config import BusConfig
from fieldtwin.gateway.protocols.modbus.frames.selection import framing_of
from fieldtwin.gateway.protocols.modbus.server.analysis import READ_FUNCTIONS
from fieldtwin.gateway.runtime.audit_log import AuditLog
from fieldtwin.gateway.runtime.bridge.bridge import Bridge, BridgeConfig, Route
from fieldtwin.gateway.runtime.bridge.policy import LOOPBACK, AllowRule, Network, Policy
from fieldtwin.gateway.runtime.buses.modbus.modbus_bus import ModbusBus
from fieldtwin.gateway.runtime.tags import TagTable
from fieldtwin.gateway.wallclock import WallClock
from fieldtwin.twin.plant.instance import Instance

TARGET = "target"
WATCH_NS = NS_PER_S // 5


@dataclass(frozen=True)
class BridgeOptions:
    """The options of the command line.

    `units` maps a client's unit ID to the target's; if it is empty, every unit ID is passed on unchanged. `pause_s` is
    the pause in seconds after each exchange with the target. `echo`: the target's serial adapter returns the bytes that
    are sent.
    """

    listen: Endpoint
    target: Endpoint
    networks: tuple[Network, ...] = LOOPBACK
    allow_writes: bool = False
    units: tuple[tuple[int, int], ...] = ()
    timeout_s: float = 1.0
    retries: int = 1
    cache_ms: int = 0
    clients: int = 16
    queue: int = 32
    broadcast: bool = False
    answer_broadcast: bool = False
    pause_s: float = 0.0
    echo: bool = False
    idle_s: float = 0.0
    roles: frozenset[str] | None = None
    instance: str = ""


def bridge_config(options: BridgeOptions) -> BridgeConfig:
    """Return the configuration of the bridge. It forwards only reading functions, or every function if writes are allowed."""
    functions = frozenset(range(1, 128)) if options.allow_writes else READ_FUNCTIONS
    return BridgeConfig(
        name="bridge",
        listen=options.listen,
        to=None if options.units else TARGET,
        routes={unit: Route(TARGET, there) for unit, there in options.units},
        policy=Policy(
            (AllowRule(networks=options.networks, functions=functions, roles=options.roles),), options.allow_writes
        ),
        broadcast=options.broadcast or options.answer_broadcast,
        answer_broadcast=options.answer_broadcast,
        cache_ms=options.cache_ms,
        clients=options.clients,
        queue=options.queue,
        idle_s=options.idle_s,
        keep_trying=False,
    )


def instance_name(options: BridgeOptions) -> str:
    """Return the name of the run directory for the audit log; the listening endpoint distinguishes the bridges of a host."""
    where = (
        f"{options.listen.host}-{options.listen.port or os.getpid()}" if options.listen.host else options.listen.path
    )
    return options.instance or "bridge-" + re.sub(r"[^A-Za-z0-9.]+", "-", where).strip("-")[-32:]


async def run_bridge(options: BridgeOptions, report: Callable[[str], None]) -> dict[str, Any]:
    """Run the bridge until SIGINT or SIGTERM and return its counters. `report` is called with each status message for the user.

    Raises `UsageError` for endpoints that cannot form a bridge, `EndpointBusy` or `Unreachable` when it cannot listen.
    """
    framing_of(options.target)
    if options.listen == options.target:
        raise UsageError("a bridge has two ends", got=f"{options.listen} twice")
    stop = stop_signal()
    clock, connector = WallClock(), OsConnector()
    with Instance(instance_name(options)) as instance:
        audit = AuditLog(instance.path("audit.jsonl"), clock)
        try:
            config = BusConfig(
                TARGET, options.target, options.timeout_s, options.retries, spacing_s=options.pause_s, echo=options.echo
            )
            bus = ModbusBus(config, [], connector, clock, TagTable(clock), lambda driver: None)
            bridge = Bridge(bridge_config(options), {TARGET: bus}, connector, clock, audit)
            if options.allow_writes:
                report(f"writes are recorded in {instance.path('audit.jsonl')}")
            async with Nursery() as nursery:
                nursery.start(bus.run(), "target")
                nursery.start(bridge.run(), "bridge")
                stopping = nursery.start(stop.wait(), "until stopped")
                nursery.start(_report(bridge, bus, clock, report), "report")
                failing = asyncio.ensure_future(nursery.wait())
                try:
                    await asyncio.wait([stopping, failing], return_when=asyncio.FIRST_COMPLETED)
                    if failing.done():
                        failing.result()
                    status = msgspec.to_builtins(bridge.status())
                    counters = status.pop("counters")
                    return {**status, **counters, "target": dict(bus.totals()), "target_error": bus.error}
                finally:
                    failing.cancel()
        finally:
            audit.close()


async def _report(bridge: Bridge, bus: ModbusBus, clock: WallClock, report: Callable[[str], None]) -> None:
    """Report where the bridge listens, and each loss and return of its listening endpoint or bus. Both are retried forever."""
    said: tuple[str, str] | None = None
    while True:
        bound = bridge.front.bound
        here = bridge.front.error if bound is None else ""
        there = "" if bus.connected else bus.error
        settled = bus.connected or there
        if settled and (bound is not None or bridge.config.listen.is_serial) and (here, there) != said:
            if said is None or not (here or there):
                report(f"{bound or bridge.config.listen}  →  {bus.config.endpoint}")
            for error in filter(None, (here, there)):
                report(f"waiting: {error}")
            said = here, there
        await clock.sleep_until_ns(clock.monotonic_ns() + WATCH_NS)
