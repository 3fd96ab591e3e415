"""The process of the simulated field devices: ``python -m fieldtwin.twin.prototype.field_process CONFIG.json``, or
inside `fieldtwin emulate SYSTEM`.

Commands of the control channel: ready, get (listening endpoints, counters), held (the values that the devices really
held), fault, clear, set, lease, fresh, stop. The channel is a Unix socket in the run directory, and TCP if configured,
so that a controller on another host learns where the emulator of each plant endpoint listens.

    lease     {"id": ..., "for_s": 10}: open the lease `id` on these devices (`fieldtwin.twin.prototype.field_leases`);
              {"renew": true} prolongs it, {"release": true} ends it. What `fault` and `set` inject with "lease": ID is
              removed when that lease ends
    fresh     {"lease": ID}: restart every device, recording and simulation from its beginning, on the same ports and
              without a fault
"""

from __future__ import annotations

import asyncio
import os
import secrets
import sys
from collections.abc import Callable
from contextlib import AsyncExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec

from fieldtwin.emulators.endpoints.acoustic_end import AcousticEnd
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.concurrency.stop_signal import on_stop_signal
from fieldtwin.gateway.core.control import ControlServer
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import FileInvalid, UsageError
from fieldtwin.gateway.wallclock import WallClock
from fieldtwin.twin.plant.child_main import child_main
from fieldtwin.twin.prototype.field import FieldSimulator
from fieldtwin.twin.prototype.field_leases import LEASE_S, FieldLeases
from fieldtwin.twin.prototype.field_status import FieldStatus
from fieldtwin.twin.prototype.file import Prototype, load_prototype
from fieldtwin.twin.prototype.prototype import DigitalTwinPrototype
from fieldtwin.twin.site.resolved import read_resolved
from fieldtwin.twin.site.system import System, load_system

HELD_AT_ONCE = 5_000
"""Largest number of entries of each device in one answer: after hours there are more than fit into one line of the control
channel.
"""


class FieldConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The configuration of the process.

    `recordings` maps a device to a file, and `listen` a bus to an endpoint; both override the prototype file. `seed`
    None means the prototype file's. `control` is ``HOST:PORT`` for a TCP control channel, or empty.
    """

    system: str
    run_dir: str
    prototype: str = ""
    profiles: tuple[str, ...] = ()
    recordings: dict[str, str] = {}
    speed: float = 0.0
    listen: dict[str, str] = {}
    control: str = ""
    token: str = ""
    seed: int | None = None
    resolved: str = ""
    """System and prototype as the run has read them (`fieldtwin.twin.site.resolved`); empty: they are read from the files
    above.
    """
    water: dict[str, tuple[str, str]] = {}
    """Transmitters that are in a network's acoustic channel: the Unix socket that serves the channel, and their names
    there.
    """


def resolve(config: FieldConfig, system: System | None = None) -> DigitalTwinPrototype:
    """Read system and prototype file, apply the command line's options, and return the prototype, with emulators and drivers
    checked against each other.

    With `system` its file is not read again.
    """
    return DigitalTwinPrototype(*resolve_files(config, system), WallClock())


def resolve_files(config: FieldConfig, system: System | None = None) -> tuple[System, Prototype]:
    """Return the system and the prototype that `config` names, for the field devices only: without gateway, PLC and programs."""
    if config.resolved:
        handed_over, prototype = read_resolved(config.resolved)
        assert isinstance(handed_over, System)
        assert isinstance(prototype, Prototype)
        return handed_over, prototype
    if system is None:
        system = load_system(config.system, [Path(p) for p in config.profiles])
    prototype = load_prototype(system, Path(config.prototype) if config.prototype else None)
    for device, path in config.recordings.items():
        if device not in prototype.devices:
            raise UsageError(f"no emulated device {device!r}", expected=", ".join(prototype.devices))
        prototype = prototype.with_recording(device, Path(path))
    if config.speed:
        prototype = prototype.with_speed(config.speed)
    if config.seed is not None:
        prototype = replace(prototype, seed=config.seed)
    for bus, url in config.listen.items():
        if bus not in prototype.buses:
            raise UsageError(f"no bus {bus!r}", expected=", ".join(prototype.buses))
        prototype = prototype.with_listen(system, bus, Endpoint.parse(url))
    return system, prototype


class FieldProcess:
    """The simulated field devices with their control channel, which run until they are stopped."""

    def __init__(self, config: FieldConfig, twin: DigitalTwinPrototype | None = None) -> None:
        """Serve `twin`; without it, the prototype that `config` names."""
        self._config = config
        self._twin = twin or resolve(config)
        self._clock = WallClock()
        self._stop = asyncio.Event()
        self._failure: FileInvalid | None = None
        self._fresh_asked = asyncio.Event()
        self._fresh_done: asyncio.Future[None] | None = None
        self._lease_changed = asyncio.Event()
        self._field: FieldSimulator
        self._leases: FieldLeases
        self.control_port = 0
        # Identity of these devices. Devices that are created again get a different identity, and their counters start again.
        self._life = secrets.token_hex(8)

    async def run(self, on_ready: Callable[[FieldSimulator], None] | None = None) -> int:
        """Open the devices, call `on_ready`, and serve until stopped. Return the exit code."""
        run_dir = Path(self._config.run_dir)
        async with AsyncExitStack() as stack:
            water = {}
            for device, (path, name) in self._config.water.items():
                water[device] = end = await AcousticEnd.open(Path(path), name)
                stack.push_async_callback(end.aclose)
            self._field = self._twin.field(run_dir, water=water)
            self._leases = FieldLeases(self._field.faults)
            return await self._run(run_dir, on_ready)

    async def _run(self, run_dir: Path, on_ready: Callable[[FieldSimulator], None] | None) -> int:
        await self._field.open()
        server = ControlServer(
            {
                "ready": self._ready,
                "get": self._get,
                "held": self._held,
                "fault": self._fault,
                "clear": self._clear,
                "set": self._set,
                "lease": self._lease,
                "fresh": self._fresh,
                "stop": self._request_stop,
            },
            token=self._config.token,
        )
        socket = run_dir / "field.sock"
        try:
            await server.listen_unix(socket)
            if self._config.control:
                host, _, port = self._config.control.rpartition(":")
                if not port.isdigit():
                    raise UsageError("the control channel's address", expected="HOST:PORT", got=self._config.control)
                self.control_port = await server.listen_tcp(host or "127.0.0.1", int(port))
            on_stop_signal(self._stop.set)
            asyncio.get_running_loop().set_exception_handler(self._on_exception)
            if on_ready is not None:
                on_ready(self._field)
            await self._serve()
        finally:
            await server.aclose()
            socket.unlink(missing_ok=True)
            await self._field.aclose()
        if self._failure is not None:
            raise self._failure
        return 0

    def _on_exception(self, loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        """End the process if a simulation failed while a client was served. Other failures end that client only."""
        error = context.get("exception")
        if isinstance(error, FileInvalid):
            self._failure = self._failure or error
            self._stop.set()
        else:
            loop.default_exception_handler(context)

    async def _serve(self) -> None:
        async with Nursery() as nursery:
            stopping = nursery.start(self._stop.wait(), "until stopped")
            expiring = nursery.start(self._end_leases(), "leases")
            while not stopping.done():
                asked = asyncio.ensure_future(self._fresh_asked.wait())
                running = asyncio.ensure_future(self._field.run())
                try:
                    await asyncio.wait([running, stopping, asked, expiring], return_when=asyncio.FIRST_COMPLETED)
                    if running.done():
                        running.result()
                    if expiring.done():
                        expiring.result()
                finally:
                    asked.cancel()
                    running.cancel()
                    await asyncio.gather(asked, running, return_exceptions=True)
                if self._fresh_asked.is_set() and not stopping.done():
                    self._fresh_asked.clear()
                    await self._recreate()

    async def _end_leases(self) -> None:
        """Remove what a test runner injected as soon as its lease has expired."""
        while True:
            self._lease_changed.clear()
            until_ns = self._leases.until_ns
            if until_ns is None:
                await self._lease_changed.wait()
                continue
            left_s = (until_ns - self._clock.monotonic_ns()) / NS_PER_S
            try:
                async with asyncio.timeout(max(0.0, left_s)):
                    await self._lease_changed.wait()
            except TimeoutError:
                self._leases.expire(self._clock.monotonic_ns())

    async def _recreate(self) -> None:
        """Create all devices again from the same prototype, on the same endpoints. A failure ends the process."""
        old, done = self._field, self._fresh_done
        old.end_simulations()
        prototype = _listening_as(self._twin.prototype, old)
        self._field = FieldSimulator(old.system, prototype, Path(self._config.run_dir), self._clock)
        try:
            await self._field.open()
        except BaseException as e:
            if done is not None and not done.done() and isinstance(e, Exception):
                done.set_exception(e)
            raise
        self._leases.moved_to(self._field.faults)
        self._life = secrets.token_hex(8)
        if done is not None and not done.done():
            done.set_result(None)

    async def _ready(self, args: dict[str, Any]) -> dict[str, Any]:
        return {"ready": True, "pid": os.getpid()}

    async def _get(self, args: dict[str, Any]) -> FieldStatus:
        lease = self._leases.status(self._clock.monotonic_ns())
        return msgspec.structs.replace(self._field.status(), life=self._life, lease=lease)

    async def _held(self, args: dict[str, Any]) -> dict[str, Any]:
        """Return the values that each device held, at most `HELD_AT_ONCE` per device, the oldest first. A caller repeats the
        request for more.
        """
        since = {str(name): int(number) for name, number in (args.get("since") or {}).items()}
        return {name: held[:HELD_AT_ONCE] for name, held in self._field.held_since(since).items()}

    async def _fault(self, args: dict[str, Any]) -> dict[str, Any]:
        """Inject ``{"fault": {"name": ..., "device": ...}}``; its times count from ``"start_ns"`` (monotonic), if given.

        With ``"lease"`` it is removed when that lease ends.
        """
        start_ns = args["start_ns"] if isinstance(args.get("start_ns"), int) else None
        said = args.get("fault")
        if not isinstance(said, dict):
            raise UsageError("a fault", expected='{"name": ..., "device": ...}', got=repr(said)[:60])
        if args.get("lease"):
            id = self._leases.inject(str(args["lease"]), said, start_ns, self._clock.monotonic_ns())
        else:
            id = self._field.faults.inject(said, start_ns)
        faults = self._field.faults
        return {"id": id, "number": faults.history.count, "faults": faults.active()}

    async def _clear(self, args: dict[str, Any]) -> dict[str, Any]:
        self._field.faults.clear(str(args.get("id", "")))
        return {"faults": self._field.faults.active()}

    async def _set(self, args: dict[str, Any]) -> dict[str, Any]:
        device, tag, value = str(args.get("device", "")), str(args.get("tag", "")), args.get("value")
        if args.get("lease"):
            self._leases.set_value(str(args["lease"]), device, tag, value, self._clock.monotonic_ns())
        else:
            self._field.faults.set_value(device, tag, value)
        return {"number": self._field.faults.history.count}

    async def _lease(self, args: dict[str, Any]) -> dict[str, Any]:
        """Open, prolong or end a test runner's lease. The answer names the faults and values that are active."""
        id, for_s, now_ns = str(args.get("id", "")), args.get("for_s", LEASE_S), self._clock.monotonic_ns()
        if not isinstance(for_s, int | float):
            raise UsageError("how long a lease lasts", expected="a number of seconds", got=repr(for_s)[:60])
        if args.get("release") is True:
            self._leases.release(id)
        elif args.get("renew") is True:
            self._leases.renew(id, for_s, now_ns)
        else:
            self._leases.open(id, for_s, now_ns)
        self._lease_changed.set()
        faults = self._field.faults
        return {
            "life": self._life,
            "lease": self._leases.status(now_ns),
            "faults": faults.active(),
            "set": faults.values_set(),
        }

    async def _fresh(self, args: dict[str, Any]) -> dict[str, Any]:
        """Create all devices again, and return when the new devices listen.

        Raises `LeaseEnded` or `UsageError`, and changes nothing then.
        """
        self._leases.of(str(args.get("lease", "")), self._clock.monotonic_ns())
        if self._config.water:
            raise UsageError("the devices of a network cannot be restarted one system at a time")
        if self._fresh_done is None or self._fresh_done.done():
            self._fresh_done = asyncio.get_running_loop().create_future()
        self._fresh_asked.set()
        await asyncio.shield(self._fresh_done)
        return {"life": self._life, "now_ns": self._clock.monotonic_ns()}

    async def _request_stop(self, args: dict[str, Any]) -> FieldStatus:
        asyncio.get_running_loop().call_later(0.05, self._stop.set)
        return self._field.status()


def _listening_as(prototype: Prototype, field: FieldSimulator) -> Prototype:
    """Return `prototype` with every bus and every remote modem at the endpoint that it has in `field`, so that ports stay the
    same.
    """
    buses = {
        name: replace(bus, listen=field.listening[name]) if name in field.listening else bus
        for name, bus in prototype.buses.items()
    }
    devices = {
        name: replace(device, form=device.form.model_copy(update={"far": str(field.far[name])}))
        if name in field.far
        else device
        for name, device in prototype.devices.items()
    }
    return replace(prototype, buses=buses, devices=devices)


def main(argv: list[str]) -> int:
    """Run the process; an error is printed to stderr as one line."""
    return child_main(argv, FieldConfig, lambda config: FieldProcess(config).run())


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
