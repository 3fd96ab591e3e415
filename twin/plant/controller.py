"""The gateway's process: ``python -m fieldtwin.twin.plant.controller CONFIG.json``, the same for a plant and its prototype.

The configuration names the system file, the run directory and, for a prototype, where each plant endpoint is opened
instead. Only the Connector receives that mapping. Commands of the control channel: ready, get, published, watch, gate,
write, client_tags, acknowledge, shelve, unshelve, refuse, command, report, reload, stop.
"""

from __future__ import annotations

import asyncio
import os
import sys
from contextlib import suppress
from datetime import UTC, datetime
from math import isfinite
from pathlib import Path
from typing import Any

import msgspec

from fieldtwin.gateway.connections.os_connector import OsConnector
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.concurrency.stop_signal import on_stop_signal
from fieldtwin.gateway.core.connection import Connector
from fieldtwin.gateway.core.control import ControlServer
from fieldtwin.gateway.core.errors import FieldtwinError, ReplyTimeout, Unreachable, UsageError
from fieldtwin.gateway.devices.register_device import RegisterDriver
from fieldtwin.gateway.runtime.audit_log import AuditLog
from fieldtwin.gateway.runtime.buses.modbus.learnt_gaps import LearntFile, learnt_statuses
from fieldtwin.gateway.runtime.gateway_status import AlarmStatus, ConfigStatus, GatewayStatus, StoppedGateway
from fieldtwin.gateway.runtime.mailboxes.acked_commands import AckedCommandStore
from fieldtwin.gateway.runtime.outputs.refusals import RefusalCause
from fieldtwin.gateway.runtime.reconfigure import reconfigure
from fieldtwin.gateway.runtime.status import describe
from fieldtwin.gateway.store.exchange_log import ExchangeLog
from fieldtwin.gateway.wallclock import WallClock
from fieldtwin.twin.plant.child_main import child_main
from fieldtwin.twin.plant.mapping import MappedConnector, mapping_from_json
from fieldtwin.twin.plant.physical import EmbeddedControlSystem, attached, gateway_config
from fieldtwin.twin.plant.refusal_places import RefusalPlaces
from fieldtwin.twin.plant.reloading import compare, limits_changed
from fieldtwin.twin.plant.server_reports import ServerReports
from fieldtwin.twin.plant.watching import TagWatch
from fieldtwin.twin.site.resolved import read_resolved, write_resolved
from fieldtwin.twin.site.system import System, load_system

FLUSH_EVERY_NS = NS_PER_S // 2
LOOK_EVERY_NS = NS_PER_S // 20
FLUSH_ROWS = 8
"""Number of waiting log entries that triggers an immediate flush: the PLC keeps its entries until they are stored, at most 16
of each program.
"""
MOST_COMMAND_BYTES = 64
WRITE_WITHIN_S = 5.0
MOST_NAME = 128
"""The largest number of characters of the name of a client in the audit log."""
MOST_COMMENT = 200
"""The largest number of characters of a user's comment in the audit log."""
MOST_REPORTED_CHANGES = 20
PUBLISHED_AT_ONCE = 20_000
"""The largest number of journal entries (published values) that fits into one line of the control channel."""


class ControllerConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The configuration of the process.

    `mapping` gives for each endpoint of the plant the endpoint that is opened instead; None on a plant. With `fixed_ports` a
    prototype serves and bridges at the addresses of the system file, otherwise on free ports. `capture` is the file in which bus
    traffic is recorded; empty for none. `allow_writes` does not apply to the buses in `read_only`.
    """

    system: str
    run_dir: str
    allow_writes: bool
    read_only: tuple[str, ...] = ()
    mapping: dict[str, str] | None = None
    fixed_ports: bool = False
    profiles: tuple[str, ...] = ()
    capture: str = ""
    delegated: tuple[str, ...] = ()
    """Transmitters whose mailboxes are used by the digital thread."""
    resolved: str = ""
    """The system as the run has read it (`fieldtwin.twin.site.resolved`); empty: this process reads `system` itself."""


class GatewayProcess:
    """One gateway with its control channel, which runs until it is stopped."""

    def __init__(self, config: ControllerConfig) -> None:
        self._config = config
        self._clock = WallClock()
        self._stop = asyncio.Event()
        self._store_error = ""
        self._reloads = 0
        self._changed: list[str] = []
        self._reloading = asyncio.Lock()

    def _load(self) -> System:
        return load_system(self._config.system, [Path(p) for p in self._config.profiles])

    def _handed_over(self) -> System:
        [system] = read_resolved(self._config.resolved)
        assert isinstance(system, System)
        return system

    async def run(self) -> int:
        run_dir = Path(self._config.run_dir)
        system = self._system = self._handed_over() if self._config.resolved else self._load()
        connector: Connector = OsConnector()
        if self._config.mapping is not None:
            connector = MappedConnector(connector, mapping_from_json(self._config.mapping))
        tap = None
        if self._config.capture:
            from fieldtwin.gateway.connections.tap import TapFile, TappedConnector

            started = datetime.fromtimestamp(self._clock.utc_ns() / NS_PER_S, UTC).isoformat(timespec="milliseconds")
            of_run = {"started": started, "system": system.name, "prototype": self._config.mapping is not None}
            tap = TapFile(Path(self._config.capture), head={**of_run, "t_ns": self._clock.monotonic_ns()})
            connector = TappedConnector(connector, [tap], self._clock)
        audit = self._audit = AuditLog(run_dir / "audit.jsonl", self._clock)
        log = ExchangeLog(run_dir / "store.sqlite", system=system.name, prototype=self._config.mapping is not None)
        try:
            ecs = EmbeddedControlSystem(system)
            with attached(ecs.layout, run_dir / "image") as image:
                # A prototype has separate files: data learnt from emulators does not describe the plant's devices.
                of = "" if self._config.mapping is None else ".prototype"
                self._gateway = ecs.gateway(
                    connector,
                    self._clock,
                    image,
                    audit,
                    log,
                    allow_writes=self._config.allow_writes,
                    read_only=self._config.read_only,
                    free_ports=self._config.mapping is not None and not self._config.fixed_ports,
                    true_silences=self._config.mapping is None,
                    delegated=self._config.delegated,
                    taken=AckedCommandStore(run_dir / f"taken{of}.json"),
                )
                drivers = [d for d in self._gateway.drivers.values() if isinstance(d, RegisterDriver)]
                self._learnt = LearntFile(run_dir / f"learnt{of}.json", drivers, system.buses)
                self._learnt.load()
                journal = self._gateway.outputs.journal
                self._places = RefusalPlaces(journal, run_dir / "plc.sock", tap.on_refusal if tap else None)
                self._reports = ServerReports(system.serving, self._clock)
                self._watching = TagWatch(self._gateway.tags, self._clock, journal, self._gateway.alarms)
                await self._serve(run_dir / "gateway.sock")
        finally:
            log.close()
            audit.close()
            if tap is not None:
                tap.close()
        return 0

    async def _serve(self, socket: Path) -> None:
        server = ControlServer(
            {
                "ready": self._ready,
                "get": self._get,
                "published": self._published,
                "watch": self._watch,
                "gate": self._gate,
                "write": self._write,
                "client_tags": self._client_tags,
                "acknowledge": self._acknowledge,
                "shelve": self._shelve,
                "unshelve": self._unshelve,
                "refuse": self._refuse,
                "command": self._command,
                "report": self._reports.report,
                "reload": self._reload,
                "stop": self._request_stop,
            }
        )
        await server.listen_unix(socket)
        on_stop_signal(self._stop.set)
        try:
            async with Nursery() as nursery:
                running = nursery.start(self._gateway.run(), "gateway")
                nursery.start(self._flush(), "store")
                nursery.start(self._places.run(), "lines of refused outputs")
                stopping = asyncio.ensure_future(self._stop.wait())
                try:
                    await asyncio.wait([running, stopping], return_when=asyncio.FIRST_COMPLETED)
                finally:
                    stopping.cancel()
                if running.done():
                    running.result()
                await self._gateway.shut_down()
        finally:
            await server.aclose()
            socket.unlink(missing_ok=True)

    async def _flush(self) -> None:
        """Store the log twice a second, or earlier if many entries wait. If writing fails, report it and try again."""
        flushed_ns = self._clock.monotonic_ns()
        while True:
            await self._clock.sleep_until_ns(self._clock.monotonic_ns() + LOOK_EVERY_NS)
            now_ns = self._clock.monotonic_ns()
            if now_ns - flushed_ns < FLUSH_EVERY_NS and self._gateway.log.waiting < FLUSH_ROWS:
                continue
            flushed_ns = now_ns
            try:
                await asyncio.to_thread(self._gateway.log.flush)
                self._learnt.save()
                self._store_error = ""
            except Unreachable as e:
                self._store_error = str(e)

    async def _ready(self, args: dict[str, Any]) -> dict[str, Any]:
        return {"ready": True, "pid": os.getpid()}

    async def _get(self, args: dict[str, Any]) -> GatewayStatus:
        return self._status(brief=args.get("brief") is True)

    def _status(self, *, brief: bool = False) -> GatewayStatus:
        status = describe(self._gateway, self._clock.monotonic_ns(), brief=brief)
        return msgspec.structs.replace(
            status,
            serve=status.serve | self._reports.statuses(),
            learnt=learnt_statuses(self._gateway.drivers.values()),
            store_error=self._store_error,
            config=ConfigStatus(
                system=self._system.name, hash=self._system.hash, reloads=self._reloads, changed=self._changed
            ),
        )

    async def _published(self, args: dict[str, Any]) -> dict[str, Any]:
        """Return the values published after number `since`, at most `PUBLISHED_AT_ONCE`, the oldest first. A caller repeats the
        request for more.
        """
        since = int(args.get("since", 0))
        tags = self._gateway.tags
        newer = tags.journal_since(since)[:PUBLISHED_AT_ONCE]
        entries = [(p.number, p.tag, p.raw.hex(), p.t_ns, _plain(p.value)) for p in newer]
        return {"entries": entries, "published": tags.published, "dropped": tags.journal_dropped}

    async def _watch(self, args: dict[str, Any]) -> dict[str, Any]:
        """Return changes of tags since the last request, and values of some tags (`fieldtwin.twin.plant.watching`)."""
        return self._watching.answer(args)

    async def _gate(self, args: dict[str, Any]) -> dict[str, Any]:
        """Return the plant's current switch position and the current limits of commands from a digital twin."""
        may = self._system.commands
        return {"remote": self._gateway.config.remote, "period_s": list(may.period_s), "per_minute": may.per_minute}

    async def _write(self, args: dict[str, Any]) -> dict[str, Any]:
        """Write a tag once for a user (``by``), under the rules for clients, and answer when the device has confirmed it.

        Raises `NotAllowed` for a read-only plant, a tag that is not writable or that the PLC commands, and a value outside its
        limits; and the device's error. Each of these is in the audit log. Raises `ReplyTimeout` after `WRITE_WITHIN_S` seconds.
        """
        tag, value = args.get("tag"), args.get("value")
        if (
            not isinstance(tag, str)
            or isinstance(value, bool)
            or not isinstance(value, int | float)
            or not isfinite(value)
        ):
            raise UsageError(
                "a write", expected='{"tag": DEVICE.TAG, "value": NUMBER, "by": USER}', got=repr(args)[:80]
            )
        done: asyncio.Future[FieldtwinError | None] = asyncio.get_running_loop().create_future()

        def end(error: FieldtwinError | None) -> None:
            if not done.done():
                done.set_result(error)

        self._gateway.offer(tag)
        self._gateway.outputs.request(tag, float(value), str(args.get("by", ""))[:MOST_NAME], end)
        try:
            async with asyncio.timeout(WRITE_WITHIN_S):
                error = await done
        except TimeoutError as e:
            raise ReplyTimeout(
                f"no confirmation within {WRITE_WITHIN_S:g} s; the value may still be written", where=tag
            ) from e
        if error is not None:
            raise error
        return {"tag": tag, "value": value}

    async def _client_tags(self, args: dict[str, Any]) -> list[str]:
        """Return the tags that a client may write now. A reload may change them."""
        return self._gateway.client_tags()

    async def _acknowledge(self, args: dict[str, Any]) -> AlarmStatus:
        """Acknowledge the `alarm` for a user (``by``, ``comment``), and return its new status.

        Raises `UsageError` if there is nothing to acknowledge, as the next two commands do if they cannot be carried out.
        """
        alarm, by, now_ns = self._alarm_request(args)
        self._gateway.alarms.acknowledge(alarm, by, now_ns, str(args.get("comment", ""))[:MOST_COMMENT])
        return self._gateway.alarms.statuses(now_ns)[alarm]

    async def _shelve(self, args: dict[str, Any]) -> AlarmStatus:
        """Shelve the `alarm` for `for_s` seconds for a user (``by``), and return its new status."""
        alarm, by, now_ns = self._alarm_request(args)
        for_s = args.get("for_s")
        if isinstance(for_s, bool) or not isinstance(for_s, int | float):
            raise UsageError("the time for which an alarm is shelved", expected="seconds", got=repr(for_s)[:80])
        self._gateway.alarms.shelve(alarm, for_s, by, now_ns)
        return self._gateway.alarms.statuses(now_ns)[alarm]

    async def _unshelve(self, args: dict[str, Any]) -> AlarmStatus:
        """End the shelving of the `alarm` for a user (``by``), and return its new status."""
        alarm, by, now_ns = self._alarm_request(args)
        self._gateway.alarms.unshelve(alarm, by, now_ns)
        return self._gateway.alarms.statuses(now_ns)[alarm]

    def _alarm_request(self, args: dict[str, Any]) -> tuple[str, str, int]:
        return str(args.get("alarm", ""))[:MOST_NAME], str(args.get("by", ""))[:MOST_NAME], self._clock.monotonic_ns()

    async def _refuse(self, args: dict[str, Any]) -> dict[str, Any]:
        """Record a write that a server in a separate process has refused (``tag``, ``value``, ``reason``, ``cause``, ``by``).

        `cause` is the value of a `RefusalCause`. Raises `UsageError` for any other.
        """
        cause = args.get("cause")
        if cause not in (RefusalCause.LIMIT.value, RefusalCause.NOT_WRITABLE.value):
            expected = f"{RefusalCause.LIMIT.value} or {RefusalCause.NOT_WRITABLE.value}"
            raise UsageError("the cause of a refusal", expected=expected, got=repr(cause)[:80])
        tag, value, reason, by = (str(args.get(key, ""))[:MOST_NAME] for key in ("tag", "value", "reason", "by"))
        self._gateway.outputs.refusals += 1
        journal, now_ns = self._gateway.outputs.journal, self._clock.monotonic_ns()
        journal.note(tag.partition(".")[0], tag, value, RefusalCause(cause), reason, by, now_ns)
        return {"recorded": True}

    async def _command(self, args: dict[str, Any]) -> dict[str, Any]:
        """Pass a command of the digital twin (``payload`` in hex) to the control logic, as if the transmitter had received it."""
        if len(self._gateway.pumps) != 1:
            raise UsageError("a command for the transmitter", expected="one", got=str(len(self._gateway.pumps)))
        try:
            payload = bytes.fromhex(str(args.get("payload", "")))
        except ValueError as e:
            raise UsageError("a command's payload", expected="hex", got=repr(args.get("payload"))) from e
        if not payload or len(payload) > MOST_COMMAND_BYTES:
            raise UsageError("a command's payload", expected=f"1 to {MOST_COMMAND_BYTES} bytes", got=str(len(payload)))
        return {"taken": self._gateway.pumps[0].command(payload, str(args.get("by", "digital twin")))}

    async def _reload(self, args: dict[str, Any]) -> dict[str, Any]:
        """Read the files again and apply the changes: all of them, or none if one needs a restart.

        With "check" nothing is applied. Polling continues meanwhile. Raises `FileInvalid` for invalid files. The PLC
        needs the `limits` in the answer.
        """
        async with self._reloading:
            new = await asyncio.to_thread(self._load)
            changes = await asyncio.to_thread(compare, self._system, new)
            told = [{"where": c.where, "what": str(c), "live": c.live} for c in changes]
            if args.get("check") is True or not all(c.live for c in changes):
                return {
                    "applied": False,
                    "changes": told,
                    "limits": {},
                    "hash": self._system.hash,
                    "warnings": new.warnings,
                }
            limits = await asyncio.to_thread(limits_changed, self._system, new)
            if changes:
                texts = [str(c) for c in changes]
                self._audit.note("reload", new.name, by=str(args.get("by", ""))[:64], result="asked", changes=texts)
                writes, plant = self._config.allow_writes, self._config.mapping is None
                await reconfigure(
                    self._gateway,
                    gateway_config(new, allow_writes=writes, true_silences=plant, delegated=self._config.delegated),
                )
                self._reloads, self._changed = self._reloads + 1, texts[:MOST_REPORTED_CHANGES]
            self._system = new
            if self._config.resolved:  # for a process of the run that starts again later
                await asyncio.to_thread(write_resolved, Path(self._config.resolved), new)
            return {
                "applied": bool(changes),
                "changes": told,
                "limits": limits,
                "hash": new.hash,
                "warnings": new.warnings,
            }

    async def _request_stop(self, args: dict[str, Any]) -> StoppedGateway:
        """Set outputs to safe values, then stop.

        The answer says whether the devices confirmed the values, and holds the final counters.
        """
        safe = await self._gateway.shut_down()
        await self._places.settle()
        with suppress(Unreachable):  # the data will be learnt again
            self._learnt.save()
        status = self._status()
        asyncio.get_running_loop().call_later(0.05, self._stop.set)
        return StoppedGateway(safe=safe, status=status)


def _plain(value: object) -> object:
    return value.hex() if isinstance(value, bytes) else value


def main(argv: list[str]) -> int:
    """Run the process; an error is printed to stderr as one line."""
    return child_main(argv, ControllerConfig, lambda config: GatewayProcess(config).run())


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
