"""A run as a system service: its metrics page, systemd notifications and event log. All use the statuses of gateway and PLC
that the run polls in any case.

The watchdog is fed only while both the gateway and the PLC have answered within the last half of its interval: if one of them
hangs or has ended, systemd stops all processes of the service in order and starts them again.
"""

from __future__ import annotations

import asyncio
import sys
from dataclasses import dataclass
from types import TracebackType

from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.errors import FieldtwinError
from fieldtwin.run.live.session import RunSession
from fieldtwin.service.events import Priority, ServiceEvent, changes
from fieldtwin.service.exposition import render
from fieldtwin.service.journal import EventLog, Format
from fieldtwin.service.metrics import RunState, families
from fieldtwin.service.metrics_server import MetricsServer, parse_place
from fieldtwin.service.notify import Notifier
from fieldtwin.twin.plant.physical import program_warnings

LOOK_S = 0.5
STATUS_S = 5.0
MOST_NAMED = 8
NEEDED = ("gateway", "plc")


@dataclass(frozen=True)
class ServiceOptions:
    """The options of a service. `metrics` is the address ``HOST:PORT`` of the metrics page, or empty; `log` is the format of
    events, empty for no log."""

    metrics: str = ""
    log: Format | None = None


def check(options: ServiceOptions) -> None:
    """Raise `UsageError` for an invalid combination before anything starts."""
    if options.metrics:
        parse_place(options.metrics)


def snapshot(session: RunSession) -> RunState:
    """Return the present state of the session."""
    now_ns = session.clock.monotonic_ns()
    asked = min((session.answered_ns.get(name, session.started_ns) for name in NEEDED), default=now_ns)
    return RunState(
        system=session.system.name,
        mode="prototype" if session.options.prototype else "plant",
        uptime_s=session.elapsed_s,
        gateway=session.gateway_status,
        plc=session.plc_status,
        children={name: child.returncode is None for name, child in session.children.items()},
        asked_ago_s=(now_ns - asked) / 1e9,
        thread=session.thread_status,
        gateway_ago_s=(now_ns - session.answered_ns.get("gateway", session.started_ns)) / 1e9,
        exported_tags=session.system.exported_tags,
    )


def short(seen: RunState) -> str:
    """Return one line for `systemctl status`: the system, the PLC's state, and how many devices answer."""
    if seen.gateway is None or seen.plc is None:
        return f"{seen.system}: the {'gateway' if seen.gateway is None else 'PLC'} does not answer"
    devices = seen.gateway.devices
    away = [name for name, device in devices.items() if not device.online]
    text = f"{seen.system}: PLC {seen.plc.state}, {len(devices) - len(away)} of {len(devices)} devices answer"
    return text + (f"; not {', '.join(away[:5])}{'...' if len(away) > 5 else ''}" if away else "")


class RunService:
    """A run as a system service. It works during ``async with RunService(session, options)``; `url` is the address of the
    metrics, or empty."""

    def __init__(self, session: RunSession, options: ServiceOptions, notifier: Notifier) -> None:
        self._session = session
        self._options = options
        self._notifier = notifier
        self._server: MetricsServer | None = None
        self._nursery = Nursery()
        self._log = EventLog(options.log, session.system.name, session.clock.utc_ns) if options.log else None
        self._seen: RunState | None = None
        self._hung_up = asyncio.Event()
        self.url = ""

    async def __aenter__(self) -> RunService:
        try:
            if self._options.metrics:
                self._server = MetricsServer(lambda: render(families(snapshot(self._session))))
                self.url = await self._server.open(*parse_place(self._options.metrics))
            if self._log is not None:
                self._log.write(self._started())
                for warning in (*self._session.system.warnings, *program_warnings(self._session.system)):
                    self._log.write(ServiceEvent(Priority.WARNING, "system_file", warning))
                self._nursery.start(self._tell(), "events")
            self._nursery.start(self._reload(), "reload")
            if self._notifier.wanted:
                self._notifier.ready(f"{self._session.system.name}: started")
                self._nursery.start(self._feed(), "watchdog")
        except BaseException:
            await self._close(None)
            raise
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None
    ) -> None:
        self._notifier.stopping()
        await self._close(kind)

    async def _close(self, kind: type[BaseException] | None) -> None:
        await self._nursery.__aexit__(None, None, None)
        if self._server is not None:
            await self._server.aclose()
        if self._log is not None:
            if kind is None:
                self._log.write(ServiceEvent(Priority.NOTICE, "stopping", f"{self._session.system.name}: stopping"))
            self._log.close()

    def note(self, event: ServiceEvent) -> None:
        """Log an event that the statuses do not show."""
        if self._log is not None:
            self._log.write(event)

    def hang_up(self) -> None:
        """Handle SIGHUP: read the files again. A signal during a reload starts another one after it."""
        self._hung_up.set()

    async def _reload(self) -> None:
        while True:
            await self._hung_up.wait()
            self._hung_up.clear()
            self._notifier.reloading(self._session.clock.monotonic_ns())
            event = await self._reloaded()
            if event is not None:
                self.note(event)
                if self._log is None:
                    print(f"fieldtwin: {event.message}", file=sys.stderr)
            self._notifier.ready(event.message if event is not None else "read again")

    async def _reloaded(self) -> ServiceEvent | None:
        """Reload the files and return the event to log. None if `_tell` will log it from the statuses."""
        try:
            done = await self._session.reload("SIGHUP")
        except FieldtwinError as e:
            text = f"not reloaded, nothing was changed: {e}"
            return ServiceEvent(Priority.ERROR, "not_reloaded", text, {"error": str(e)})
        if done.restart:
            named = "; ".join(f"{c['where']}: {c['what']}" for c in done.restart[:MOST_NAMED])
            more = f"; {len(done.restart) - MOST_NAMED} more" if len(done.restart) > MOST_NAMED else ""
            text = f"not reloaded, nothing was changed; these changes need a restart: {named}{more}"
            return ServiceEvent(Priority.ERROR, "not_reloaded", text, {"error": "needs a restart"})
        if done.applied and self._log is not None:
            return None
        what = (
            "reloaded: " + "; ".join(c["what"] for c in done.changes[:MOST_NAMED])
            if done.applied
            else ("reloaded: the files have not changed")
        )
        return ServiceEvent(Priority.NOTICE, "reloaded", what, {"count": len(done.changes)})

    def healthy(self, seen: RunState, patience_s: float) -> bool:
        """Return whether gateway and PLC both answered within the last `patience_s` seconds before the snapshot `seen`."""
        return seen.gateway is not None and seen.plc is not None and seen.asked_ago_s <= patience_s

    def _started(self) -> ServiceEvent:
        options = self._session.options
        mode = "prototype" if options.prototype else "plant"
        writes = "writes allowed" if options.prototype or options.allow_writes else "read-only"
        fields = {"mode": mode, "writes": writes, "run_dir": str(self._session.instance.dir), "metrics": self.url}
        return ServiceEvent(
            Priority.NOTICE, "started", f"{mode} {self._session.system.name}: started, {writes}", fields
        )

    async def _feed(self) -> None:
        """Feed the watchdog every third of its timeout; update the status line in any case."""
        pause_s = min(STATUS_S, self._notifier.watchdog_s / 3) if self._notifier.watchdog_s else STATUS_S
        while True:
            await asyncio.sleep(pause_s)
            seen = snapshot(self._session)
            if self._notifier.watchdog_s and self.healthy(seen, self._notifier.watchdog_s / 2):
                self._notifier.alive(short(seen))
            else:
                self._notifier.status(short(seen))

    async def _tell(self) -> None:
        while True:
            await asyncio.sleep(LOOK_S)
            seen = snapshot(self._session)
            for event in changes(self._seen, seen):
                self.note(event)
            self._seen = seen
