"""A run: the field simulator (of a prototype), PLC, gateway and remote client, and all their results.

Start order: process image, field simulator, PLC, gateway, remote client. Stop order is the reverse, with safe outputs
in between; the counters of gateway and emulators are read when the buses are idle. The death of a process does not end the
run: the other processes show its consequences, and the run fails. The digital thread's process, which only observes, is
restarted.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Awaitable, Callable
from contextlib import AsyncExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import msgspec

from fieldtwin.conformance.core.case import Impact
from fieldtwin.console import stderr
from fieldtwin.gateway.core.concurrency.async_resource import AsyncResource
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.control import ControlClient, OtherVersion
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import FieldtwinError, ReplyTimeout, Unreachable
from fieldtwin.gateway.runtime.gateway_status import GatewayStatus, StoppedGateway
from fieldtwin.gateway.wallclock import WallClock
from fieldtwin.northbound.opcua.access.files import check_files
from fieldtwin.northbound.process_config import MODULES, check_server
from fieldtwin.plc.status import PlcStatus
from fieldtwin.results.trace import Trace
from fieldtwin.run.live.child_configs import (
    field_config,
    gateway_config,
    read_only_buses,
    run_record,
    server_config,
    thread_config,
    transmitter_of_thread,
)
from fieldtwin.run.live.options import RunOptions
from fieldtwin.run.live.oracle import Oracle
from fieldtwin.run.live.scheduling_watch import SchedulingWatch
from fieldtwin.run.live.server_process import ServerProcess
from fieldtwin.run.live.summary import RunFacts, summarise
from fieldtwin.run.processes.children import Child, ChildFailed, naming_failures
from fieldtwin.run.processes.field_contact import FieldContact, contact_elsewhere, contact_local
from fieldtwin.run.processes.field_return import FieldReturn, is_loss
from fieldtwin.run.processes.reloading import Reloaded, reload
from fieldtwin.run.processes.run_record import SYSTEM_FILE, write_record
from fieldtwin.run.processes.states import StateWatch, expected_states
from fieldtwin.run.processes.thread_return import ThreadReturn
from fieldtwin.run.processes.topside import TopsideController, script
from fieldtwin.twin.plant.instance import Instance, capture_path
from fieldtwin.twin.plant.physical import PLC_CONFIG, PhysicalTwin
from fieldtwin.twin.prototype.field_status import FieldStatus
from fieldtwin.twin.site.resolved import write_resolved
from fieldtwin.twin.site.schema import NONE_STATED
from fieldtwin.twin.site.serving import SeparateServer
from fieldtwin.twin.site.system import System, load_system
from fieldtwin.twin.thread.place import MODEM
from fieldtwin.twin.thread.plant_thread import PlantThreadConfig
from fieldtwin.twin.thread.status import PlantThreadStatus

if TYPE_CHECKING:
    from fieldtwin.run.benches.invariant_watch import InvariantWatch
    from fieldtwin.run.live.bridge_cable import BridgeCable
    from fieldtwin.twin.prototype.file import Prototype

WATCH_S = 0.02
ANSWERS_WITHIN_S = 5.0
"""Time in seconds after which a process that has not answered counts as stopped, or as one that gets no processor time."""
ORACLE_S = 1.0
INVARIANTS_S = 0.1
"""Period in seconds of the checks of the system file's invariants."""
MAX_ERRORS = 100
SETTLE_S = 4.0
FIELD_LINGER_S = 1.5
"""Time in seconds that the emulators remain after this process was killed, in which the gateway makes its outputs safe."""

T = TypeVar("T")


class RunSession(AsyncResource):
    """One run. ``async with RunSession(options) as run: await run.wait()``, then `summary`.

    `gateway_status`, `plc_status` and `field_status` hold the latest of each, `None` while a process does not answer.
    """

    def __init__(self, options: RunOptions) -> None:
        super().__init__()
        self.options = options
        self.clock = WallClock()
        self.system: System = load_system(options.system, options.profiles)
        for server in self.system.serving.separate:
            check_server(server)
        for opcua in self.system.serving.opcua:
            check_files(opcua, self.system.name)
        self.twin = PhysicalTwin(self.system)
        self.delegated = transmitter_of_thread(options, self.system)
        self._prototype: Prototype | None = None
        if options.prototype and not options.field_host:
            from fieldtwin.twin.prototype.field_process import (
                resolve,  # imported here and below, because a plant has no emulators installed
            )

            # errors in the files are reported before anything starts
            self._prototype = resolve(field_config(options, self.system, Path()), self.system).prototype
            real = [bus.name for bus in self._prototype.buses.values() if bus.listen is None]
            read_only_buses(options, self.system, real, self.delegated)
        self.faults = options.faults
        if options.fault_file is not None:
            from fieldtwin.emulators.faults.schema import load_faults
            from fieldtwin.twin.prototype.fault_aims import target

            self.faults += load_faults(options.fault_file, lambda spec: target(self.system, spec))
        self.instance = Instance(options.instance or self.system.name)
        self.capture = options.capture or (capture_path(self.instance.name) if options.record_frames else None)
        self.mapping: dict[Endpoint, Endpoint] = {}
        self.read_only: tuple[str, ...] = ()
        """The buses of a prototype whose devices are real and are not written to."""
        self.far: dict[str, Endpoint] = {}
        self.cables: dict[str, BridgeCable] = {}
        self.counted_before: dict[str, dict[str, int]] = {}
        self.clients_before: dict[str, dict[str, dict[str, int]]] = {}
        self.children: dict[str, Child] = {}
        self.errors: deque[str] = deque(maxlen=MAX_ERRORS)
        self.oracle = Oracle()
        self.invariants: InvariantWatch | None = None
        if self.system.invariants != NONE_STATED:
            # Imported late because it loads emulators, which a plant does not need.
            from fieldtwin.run.benches.invariant_watch import InvariantWatch

            self.invariants = InvariantWatch(self.system)
        self._judging: asyncio.Task[None] | None = None
        self.states = StateWatch(self.system)
        self.topside: TopsideController | None = None
        self.gateway_status: GatewayStatus | None = None
        self.plc_status: PlcStatus | None = None
        self.field_status: FieldStatus | None = None
        self.outputs_confirmed_safe: bool | None = None
        self.thread_place = ""
        self.thread_status: PlantThreadStatus | None = None
        self.thread_return: ThreadReturn | None = None
        self.started_ns = 0
        self.answered_ns: dict[str, int] = {}  # the times at which gateway and PLC last answered
        self._scheduling = SchedulingWatch(self.clock, ANSWERS_WITHIN_S, self.note_error)
        self.stopped = asyncio.Event()
        self._nursery = Nursery()
        self._clients: dict[str, ControlClient] = {}
        self._field: FieldContact | None = None
        self._resolved = ""
        """The file from which gateway and digital thread read the system. The field simulator reads a different file."""
        self.recreated = 0
        """How often a scenario has reset the simulated devices."""
        self.field_return: FieldReturn | None = None
        """The reconnection to a remote field simulator."""

    @property
    def disturbed(self) -> bool:
        """Return whether there were faults, also those that Studio or a script injected, or the field simulator was lost; then
        gateway and emulators may count differently."""
        lost = self.field_return is not None and self.field_return.losses > 0
        injected = self.field_status is not None and any(fault.struck for fault in self.field_status.struck)
        return bool(self.faults) or injected or lost or self.recreated > 0

    @property
    def calm(self) -> bool:
        """Return whether the run had no faults, so that all must be good at its end. Recovery times are checked by scenarios."""
        return not self.faults and not self.recreated

    def summary(self) -> dict[str, Any]:
        """Return the verdict on the run, for `--json` and for printing. Call it after the run."""
        invariants, topside = self.invariants, self.topside
        return summarise(
            RunFacts(
                prototype=self.options.prototype,
                system=self.system,
                instance=self.instance.name,
                elapsed_s=self.elapsed_s,
                disturbed=self.disturbed,
                calm=self.calm,
                errors=tuple(self.errors),
                gateway=self.gateway_status,
                plc=self.plc_status,
                field=self.field_status,
                counted_before=self.counted_before,
                clients_before=self.clients_before,
                mapping=self.mapping,
                published=self.oracle.describe(),
                invariants=invariants.results() if invariants is not None else (),
                invariant_errors=invariants.errors() if invariants is not None else (),
                states=self.states.seen(),
                topside=topside.describe() if topside is not None else None,
                commands_sent=tuple(topside.commands_sent) if topside is not None else (),
                outputs_confirmed_safe=self.outputs_confirmed_safe,
                field_contact=self.field_return.describe() if self.field_return is not None else None,
                thread=self.thread_status,
                delegated=self.delegated,
            )
        )

    # -- starting -------------------------------------------------------------------------------------------------------

    async def _start(self) -> None:
        async with naming_failures(self.failure):
            await self._start_all()

    async def _start_all(self) -> None:
        self._stack.enter_context(self.instance)
        run_dir = self.instance.dir
        ecs = self.twin.ecs
        plc = ecs.prepare(run_dir, cold=self.options.cold)
        if self.options.prototype:
            await self._start_field(run_dir)
            await self._lay_cables(run_dir)
        config = run_dir / PLC_CONFIG
        config.write_bytes(plc.to_json())
        await self._start_child("plc", "fieldtwin.plc", config)
        self._resolved = write_resolved(self.instance.path(SYSTEM_FILE), self.system)
        gateway = gateway_config(
            self.options, self.system, run_dir,
            mapping=self.mapping, read_only=self.read_only, capture=self.capture, delegated=self.delegated,
            resolved=self._resolved,
        )  # fmt: skip
        await self._start_child("gateway", "fieldtwin.twin.plant.controller", self._write("gateway.json", gateway))
        self._stack.enter_context(self.states.attached(ecs.layout, run_dir / "image"))
        if self.options.thread:
            await self._start_thread(run_dir)
        self._start_servers()
        self.started_ns = self.clock.monotonic_ns()
        write_record(run_dir, run_record(self.options, self.system, self.capture, self.started_ns, self.clock.utc_ns()))
        await self._put_faults_in()
        self._start_watching()

    async def _put_faults_in(self) -> None:
        if self._field is not None:
            for fault in self.faults:  # each fault says when it begins and ends
                await self._field.client.call("fault", fault=fault, start_ns=self.started_ns)

    def _start_servers(self) -> None:
        """Start the servers of tags that run in separate processes. The gateway's status states when they listen."""
        for server in self.system.serving.separate:
            process = ServerProcess(partial(self._server_child, server), lambda error: self.note_error(str(error)))
            self._stack.push_async_callback(process.end)
            self._nursery.start(process.run(), f"process of server {server.name}")

    def _server_child(self, server: SeparateServer) -> Child:
        name, run_dir = f"{server.kind}-{server.name}", self.instance.dir
        config = self._write(f"{name}.json", server_config(self.options, run_dir, server, self._resolved))
        return Child(name, MODULES[server.kind], config, run_dir)

    async def _start_thread(self, run_dir: Path) -> None:
        """Start the plant's side of the digital thread, which observes the process image."""
        config = thread_config(
            self.options, run_dir, mapping=self.mapping, delegated=self.delegated, resolved=self._resolved
        )
        client = await self._start_child(
            "thread", "fieldtwin.twin.thread.plant_thread", self._write("thread.json", config)
        )
        self.thread_place = (await client.ask("get", PlantThreadStatus)).place
        if not self.delegated:  # the address for a restart, even if the port was chosen freely
            config = msgspec.structs.replace(config, place=self.thread_place)
        self._keep_thread(config)
        if self.delegated in self.far:
            self.thread_place = f"{MODEM}{self.far[self.delegated]}"

    def _keep_thread(self, config: PlantThreadConfig) -> None:
        def another() -> Child:
            path = self._write("thread.json", config)
            self.children["thread"] = Child("thread", "fieldtwin.twin.thread.plant_thread", path, self.instance.dir)
            return self.children["thread"]

        def came(client: ControlClient) -> None:
            self._clients["thread"] = client

        self.thread_return = ThreadReturn(
            self.children["thread"], another, came, lambda error: self.note_error(str(error))
        )
        self._stack.push_async_callback(self.thread_return.end)
        self._nursery.start(self.thread_return.run(), "thread's process")

    def _write(self, name: str, config: msgspec.Struct) -> Path:
        path = self.instance.path(name)
        path.write_bytes(msgspec.json.format(msgspec.json.encode(config), indent=2))
        path.chmod(0o600)
        return path

    async def _start_child(self, name: str, module: str, config: Path, linger_s: float = 0.0) -> ControlClient:
        child = Child(name, module, config, self.instance.dir, linger_s)
        self.children[name] = child
        self._stack.push_async_callback(child.end)
        client = await child.connect()
        self._clients[name] = client
        self._stack.push_async_callback(client.aclose)
        return client

    async def _start_field(self, run_dir: Path) -> None:
        if self.options.field_host:
            at, token = self.options.field_host, self.options.token
            self._field = await contact_elsewhere(at, token, self.system, run_dir)
            self.field_return = FieldReturn(self._field, self.system, at, token, self._field_returned)
        else:
            resolved = write_resolved(self.instance.path("prototype.pickle"), self.system, self._prototype)
            field = msgspec.structs.replace(field_config(self.options, self.system, run_dir), resolved=resolved)
            config = self._write("field.json", field)
            client = await self._start_child("field", "fieldtwin.twin.prototype.field_process", config, FIELD_LINGER_S)
            self._field = await contact_local(client, self.system, run_dir)
        self._stack.push_async_callback(self._field.aclose)
        self.mapping, self.far = self._field.mapping, self._field.far
        self.read_only = read_only_buses(self.options, self.system, self._field.real_buses, self.delegated)
        self.counted_before, self.clients_before = self._field.counted_before, self._field.clients_before
        for remark in self._field.remarks:
            stderr.print(remark, soft_wrap=True, markup=False)

    async def _lay_cables(self, run_dir: Path) -> None:
        """Create a cable for each bridge that listens on a serial line, so that the plant's own ports are not opened."""
        for bridge in self.system.serving.bridges:
            if bridge.listen.is_serial:
                # imported here, because a plant has no emulators installed
                from fieldtwin.run.live.bridge_cable import BridgeCable

                cable = await BridgeCable.open(bridge.listen, run_dir, bridge.name)
                self._stack.push_async_callback(cable.aclose)
                self._nursery.start(cable.run(), f"cable of bridge {bridge.name}")
                self.cables[bridge.name] = cable
                self.mapping[cable.plant] = cable.gateway

    async def _field_returned(self, another: bool) -> None:
        if another:
            self.oracle.begin_again()
            self.counted_before, self.clients_before = {}, {}
            await self._put_faults_in()

    @property
    def _field_client(self) -> ControlClient | None:
        """Return the control client of the field simulator while it is connected."""
        if self.field_return is not None:
            return self.field_return.client
        return self._field.client if self._field is not None else None

    def _start_watching(self) -> None:
        if self.field_return is not None:
            self._nursery.start(self.field_return.run(), "field simulator's return")
        self._nursery.start(self._watch(), "states")
        if self.invariants is not None:
            self._judging = self._nursery.start(self._check_invariants(self.invariants), "invariants")
        self._nursery.start(self._ask(), "status")
        device = next(iter(self.far), None)
        if device is not None and self.options.prototype and self.options.commands:
            # Without commands another client uses the remote end (`fieldtwin topside`): two clients would divide the
            # responses.
            self.topside = TopsideController(self.system, device, self.far[device], self.clock)
            commands = script(self.options.commands, self.options.duration_s or 20.0)
            self._nursery.start(self.topside.run(commands), "topside")

    # -- while it runs --------------------------------------------------------------------------------------------------

    async def wait(self) -> None:
        """Wait until the duration is over, `stopped` is set, or a task in this process fails."""
        waiting = self._nursery.start(self.stopped.wait(), "until stopped")
        done = asyncio.ensure_future(self._nursery.wait())
        try:
            timeout = self.options.duration_s or None
            await asyncio.wait([waiting, done], timeout=timeout, return_when=asyncio.FIRST_COMPLETED)
            if done.done():
                done.result()
            elif not waiting.done():
                await self._settle()
        finally:
            done.cancel()

    async def _check_invariants(self, invariants: InvariantWatch) -> None:
        """Check the invariants of the system file until the gateway or the PLC ends, or the run is stopped."""
        from fieldtwin.run.benches.control_bench import ControlBench, Where

        where = Where(self.instance.dir, plant=True, allowed=Impact.OBSERVE)
        try:
            async with ControlBench(self.system, where, Trace(1), target="real", names=invariants.names) as bench:
                await invariants.run(bench, INVARIANTS_S)
        except FieldtwinError as e:  # the monitoring of the processes reports which process ended
            invariants.end(str(e))
            self.note_error(f"the invariants were not checked to the end: {e}")

    async def _settle(self) -> None:
        """Wait at the end for a command in progress, for `SETTLE_S` seconds at most."""
        deadline_s = self.elapsed_s + SETTLE_S
        while self.topside is not None and self.elapsed_s < deadline_s and not self.stopped.is_set():
            expected = expected_states(self.topside.commands_sent)
            if all(self.states.sequence(p) == expected for p in self.states.relays):
                return
            await asyncio.sleep(WATCH_S)

    @property
    def elapsed_s(self) -> float:
        return (self.clock.monotonic_ns() - self.started_ns) / 1e9

    async def _watch(self) -> None:
        while True:
            self.states.look(self._scheduling.look())
            self._notice_deaths()
            await asyncio.sleep(WATCH_S)

    def _notice_deaths(self) -> None:
        for name, child in self.children.items():
            failed = child.failure()
            if failed is not None and name in self._clients:
                del self._clients[name]
                self.note_error(str(failed))

    def failure(self) -> ChildFailed | None:
        """Return why the first process that has ended did so, or None while all run."""
        return next((failed for child in self.children.values() if (failed := child.failure())), None)

    def note_error(self, text: str) -> None:
        """Record an error, unless the same text is already recorded."""
        if text not in self.errors:
            self.errors.append(text)

    async def _ask(self) -> None:
        """Query the three statuses twice a second, and run the check of values once a second."""
        next_oracle = 0.0
        while True:
            await self.refresh()
            if self.elapsed_s >= next_oracle:
                next_oracle = self.elapsed_s + ORACLE_S
                await self._judge()
            await asyncio.sleep(0.4)

    async def refresh(self) -> None:
        """Query the status of every process."""
        self.gateway_status = await self._answer(
            self._clients.get("gateway"), "gateway", lambda c: c.ask("get", GatewayStatus, ANSWERS_WITHIN_S)
        )
        self.plc_status = await self._answer(
            self._clients.get("plc"), "plc", lambda c: c.ask("get", PlcStatus, ANSWERS_WITHIN_S, brief=True)
        )
        await self._refresh_field()
        for name, status in (("gateway", self.gateway_status), ("plc", self.plc_status)):
            if status is not None:
                self.answered_ns[name] = self.clock.monotonic_ns()
        thread = await self._answer(
            self._clients.get("thread"), "thread", lambda c: c.ask("get", PlantThreadStatus, ANSWERS_WITHIN_S)
        )
        if thread is not None:
            self.thread_status = thread
            if thread.dropped:
                self.note_error(f"the thread's log lost events: {thread.store_trouble or 'they arrived too fast'}")

    async def _refresh_field(self) -> None:
        """Refresh the field simulator's status; after `start: fresh` its journals and counters begin again."""
        self.field_status = await self._ask_field("" if self.field_return is not None else "field")
        if self._field is None or self.field_status is None or self.field_status.life == self._field.life:
            return
        self._field.life = self.field_status.life
        self.recreated += 1
        self.oracle.begin_again()
        self.counted_before, self.clients_before = {}, {}

    async def _ask_field(self, name: str) -> FieldStatus | None:
        """Return the status of the field simulator; `name` as for `_answer`."""
        return await self._answer(self._field_client, name, lambda c: c.ask("get", FieldStatus, ANSWERS_WITHIN_S))

    async def _answer(
        self, client: ControlClient | None, name: str, ask: Callable[[ControlClient], Awaitable[T]]
    ) -> T | None:
        """Return the answer of a process, None without an answer. A timeout is an error of the run, if `name` is not empty."""
        if client is None:
            return None
        try:
            return await ask(client)
        except OtherVersion as e:
            self.note_error(str(e))
            return None
        except FieldtwinError as e:
            self._maybe_lost(client, e)
            if isinstance(e, ReplyTimeout) and name and not self._scheduling.was_suspended():
                self.note_error(f"{name}: the process did not answer within {ANSWERS_WITHIN_S:g} s")
            return None  # the process is ending or has ended, which _notice_deaths reports with the reason

    def _maybe_lost(self, client: ControlClient, error: FieldtwinError) -> None:
        if self.field_return is not None and client is self.field_return.client and is_loss(error):
            self.field_return.lost()

    async def _judge(self) -> None:
        await self._refresh_field()
        gateway = self._clients.get("gateway")
        field = self._field_client
        if gateway is None or field is None:
            return
        try:
            await self.oracle.update(gateway, field)
        except FieldtwinError:
            pass  # the next query reports a lost process

    async def reload(self, by: str) -> Reloaded:
        """Make gateway and PLC read their files again (`fieldtwin.run.processes.reloading`); no poll and no scan is lost."""
        if "gateway" not in self._clients:
            raise Unreachable("the gateway has ended")
        async with AsyncExitStack() as stack:
            # separate connections are used, because statuses are queried meanwhile
            own = {}
            for name in ("gateway", "plc"):
                if name in self._clients:
                    own[name] = await ControlClient.connect_unix(self.instance.path(f"{name}.sock"))
                    stack.push_async_callback(own[name].aclose)
            return await reload(own["gateway"], own.get("plc"), by)

    # -- stopping -------------------------------------------------------------------------------------------------------

    async def _stop(self) -> None:
        try:
            await self._stop_in_order()
        finally:
            await self._nursery.__aexit__(None, None, None)

    async def _end_invariant_checks(self) -> None:
        """Stop checking invariants, because the change of the outputs to safe values at the stop is not a violation."""
        if self._judging is not None:
            self._judging.cancel()
            await asyncio.wait([self._judging])

    async def _stop_in_order(self) -> None:
        self._notice_deaths()
        await self._end_invariant_checks()
        if self.topside is not None:
            await self.topside.halt()
        await self.refresh()
        gateway = self._clients.get("gateway")
        if gateway is not None:
            try:
                answer = await gateway.ask("stop", StoppedGateway, timeout_s=2.0)
                self.outputs_confirmed_safe, self.gateway_status = answer.safe, answer.status
            except FieldtwinError as e:
                self.note_error(f"the gateway did not stop in order: {e}")
        self.field_status = await self._ask_field("") or self.field_status
        await self._judge()
        if self.field_return is not None and (trouble := self.field_return.trouble):
            self.note_error(trouble)
