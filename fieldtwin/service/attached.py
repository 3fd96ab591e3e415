"""A run's service side: its metrics page, what systemd hears, and its event log, all from statuses that are asked for anyway.

The watchdog is fed only while the gateway and the PLC both have answered within the last half of its interval: a process that
hangs is as bad as one that is gone, and systemd then stops all of it in order and starts it anew.
"""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from types import TracebackType

from fieldtwin.running.session import RunSession
from fieldtwin.service.events import Event, Priority, changes
from fieldtwin.service.exposition import render
from fieldtwin.service.journal import EventLog, Format
from fieldtwin.service.metrics import Snapshot, families
from fieldtwin.service.metrics_server import MetricsServer, parse_place
from fieldtwin.service.notify import Notifier
from gateway.core.nursery import Nursery

LOOK_S = 0.5
STATUS_S = 5.0
NEEDED = ("gateway", "plc")


@dataclass(frozen=True)
class ServiceOptions:
    """`metrics` is ``HOST:PORT`` or empty; `log` is how events are written, empty for not at all."""

    metrics: str = ""
    log: Format | None = None


def check(options: ServiceOptions) -> None:
    """Raise `UsageError` for what makes no sense, before anything starts."""
    if options.metrics:
        parse_place(options.metrics)


def snapshot(session: RunSession) -> Snapshot:
    """The session as it is known now."""
    now_ns = session.clock.monotonic_ns()
    asked = min((session.answered_ns.get(name, session.started_ns) for name in NEEDED), default=now_ns)
    return Snapshot(
        system=session.system.name,
        mode="prototype" if session.options.prototype else "plant",
        uptime_s=session.elapsed_s,
        gateway=session.gateway_status,
        plc=session.plc_status,
        children={name: child.returncode is None for name, child in session.children.items()},
        asked_ago_s=(now_ns - asked) / 1e9,
        thread=session.thread_status,
    )


def short(seen: Snapshot) -> str:
    """A line for `systemctl status`."""
    if seen.gateway is None or seen.plc is None:
        return f"{seen.system}: the {'gateway' if seen.gateway is None else 'PLC'} does not answer"
    devices = seen.gateway["devices"]
    away = [name for name, device in devices.items() if not device["online"]]
    text = f"{seen.system}: PLC {seen.plc['state']}, {len(devices) - len(away)} of {len(devices)} devices answer"
    return text + (f"; not {', '.join(away[:5])}{'...' if len(away) > 5 else ''}" if away else "")


class Service:
    """``async with Service(session, options)`` around the run's waiting; `url` is where the metrics are, or empty."""

    def __init__(self, session: RunSession, options: ServiceOptions, notifier: Notifier) -> None:
        self._session = session
        self._options = options
        self._notifier = notifier
        self._server: MetricsServer | None = None
        self._nursery = Nursery()
        self._log = EventLog(options.log, session.system.name, session.clock.utc_ns) if options.log else None
        self._seen: Snapshot | None = None
        self.url = ""

    async def __aenter__(self) -> Service:
        try:
            if self._options.metrics:
                self._server = MetricsServer(lambda: render(families(snapshot(self._session))))
                self.url = await self._server.open(*parse_place(self._options.metrics))
            if self._log is not None:
                self._log.write(self._started())
                self._nursery.start(self._tell(), "events")
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
                self._log.write(Event(Priority.NOTICE, "stopping", f"{self._session.system.name}: stopping"))
            self._log.close()

    def note(self, event: Event) -> None:
        """An event that is not seen in the statuses."""
        if self._log is not None:
            self._log.write(event)

    def hang_up(self) -> None:
        """SIGHUP: nothing is read anew while a plant runs (docs/service.md); and it is no reason to end, as it else would be."""
        text = "SIGHUP: the configuration is read at the start only; restart to use another"
        self.note(Event(Priority.WARNING, "not_reloaded", text))

    def healthy(self, seen: Snapshot, patience_s: float) -> bool:
        """Whether gateway and PLC both answered within `patience_s` seconds."""
        return seen.gateway is not None and seen.plc is not None and seen.asked_ago_s <= patience_s

    def _started(self) -> Event:
        options = self._session.options
        mode = "prototype" if options.prototype else "plant"
        writes = "writes allowed" if options.prototype or options.allow_writes else "read-only"
        fields = {"mode": mode, "writes": writes, "run_dir": str(self._session.instance.dir), "metrics": self.url}
        return Event(Priority.NOTICE, "started", f"{mode} {self._session.system.name}: started, {writes}", fields)

    async def _feed(self) -> None:
        """Half as often again as systemd wants it; a line of status in any case."""
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
