"""The plant's side of a digital thread as a process: ``python -m fieldtwin.twin.thread.plant_thread CONFIG.json``.

It reads the process image, which it never writes, and shares changes: values, states with their periods, received commands and
sent responses. It writes them into its own store and sends from there. Commands from the digital twin pass through the plant's
own gate (`fieldtwin.twin.plant.command_gate`) to the gateway, as if the transmitter had received them. Only the gateway writes
the image. Commands of the control channel: ready, get, stop.
"""

from __future__ import annotations

import asyncio
import os
import secrets
import sys
from collections.abc import Sequence
from contextlib import AsyncExitStack
from pathlib import Path
from typing import Any

import msgspec
from msgspec.structs import replace

from fieldtwin.gateway.connections.os_connector import OsConnector
from fieldtwin.gateway.core.clock import NS_PER_MS, Clock
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.concurrency.stop_signal import on_stop_signal
from fieldtwin.gateway.core.connection import Connector
from fieldtwin.gateway.core.control import ControlClient, ControlServer
from fieldtwin.gateway.core.errors import FieldtwinError
from fieldtwin.gateway.core.image.image import INPUTS, OUTPUTS, ImageLayout, TagKind
from fieldtwin.gateway.core.image.snapshot import Snapshot
from fieldtwin.gateway.core.statemachine import STATE_CODES, STATES
from fieldtwin.gateway.core.values import COMMAND, RESPONSE, Quality, Reason, TagValue
from fieldtwin.gateway.runtime.audit_log import AuditLog
from fieldtwin.gateway.store.event import Event, Kind, KnowledgeStore
from fieldtwin.gateway.store.knowledge import open_knowledge
from fieldtwin.gateway.wallclock import WallClock
from fieldtwin.twin.model.knowledge import KnowledgeWriter
from fieldtwin.twin.model.mape.execute import CommandLimits
from fieldtwin.twin.model.status import encode_status
from fieldtwin.twin.model.thread_process import PTDigitalThreadProcess
from fieldtwin.twin.plant.child_main import child_main
from fieldtwin.twin.plant.command_gate import CommandGate
from fieldtwin.twin.plant.mapping import MappedConnector, mapping_from_json
from fieldtwin.twin.plant.physical import attached, gateway_lost_ms, layout_in, plc_lost_ms
from fieldtwin.twin.site.resolved import read_resolved
from fieldtwin.twin.site.system import System
from fieldtwin.twin.thread.end import ThreadEnd
from fieldtwin.twin.thread.place import delegated_transmitter, plant_carrier
from fieldtwin.twin.thread.status import PlantThreadStatus
from fieldtwin.twin.thread.thread import PTtoDTConnection, schema_of

LOOK_MS = 50
REFRESH_MS = 10_000
"""A value that does not change is shared again at this interval, so that a twin can distinguish it from a value that is no
longer reported.
"""
NAMES = list(STATES)


class PlantThreadConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The configuration of the process.

    `resolved` is the system as the run has read it (`fieldtwin.twin.site.resolved`). `place` is the address of the thread
    (`fieldtwin.twin.thread.place`), `store` a file or a database. `mapping` gives for each endpoint of the plant the endpoint
    that is opened instead; None on a plant. `every_ms` is the shortest interval between two shared values of a tag.
    """

    resolved: str
    run_dir: str
    place: str
    store: str
    prototype: bool
    mapping: dict[str, str] | None = None
    every_ms: int = 0


class ImageProcess(PTDigitalThreadProcess):
    """The thread process that shares the process image's changes. Call `look` with both regions often enough to miss no change.

    While a tag's quality stays the same, its new values are shared at most every `every_ms`. States and messages are always
    shared.

    Whether a program runs is a value with the program's name, which is bad when it does not run (paper.md, ruling 18). When
    the PLC is dead, its last state is no longer a state of the plant, and when the gateway is dead, its values are bad.
    """

    def __init__(self, system: System, layout: ImageLayout, clock: Clock, every_ms: int = 0) -> None:
        super().__init__("image", clock)
        self._every_ms = every_ms
        tags = {tag.name: tag for region in layout.regions for tag in region.tags}
        known = frozenset(schema_of(system).names)  # only tags of devices; counters of taken messages are left out
        self._plain = [n for n, t in tags.items() if t.kind is not TagKind.MESSAGE and n in known]
        self._machines = {
            p: form.outputs.get("period_s", f"{p}.period_s")
            for p, form in system.plc.programs.items()
            if f"{p}.state" in tags and [word for _, word in tags[f"{p}.state"].words] == NAMES
        }
        self._programs = list(system.plc.programs)
        self._lost_ns = {INPUTS: gateway_lost_ms(system) * NS_PER_MS, OUTPUTS: plc_lost_ms(system) * NS_PER_MS}
        self._said: dict[str, tuple[object, int]] = {}

    def look(self, inputs: Snapshot, outputs: Snapshot) -> None:
        """Share the values that are new, and those that were not shared for `REFRESH_MS`."""
        now_ns = self._clock.monotonic_ns()
        now_ms, offset_ns = self._clock.utc_ns() // NS_PER_MS, self._clock.utc_ns() - now_ns
        gateway_dead = Reason.GATEWAY_DEAD if inputs.age_ns(now_ns) > self._lost_ns[INPUTS] else Reason.NONE
        plc_dead = (
            Reason.NOT_OPERATIONAL if outputs.stopped
            else Reason.HEARTBEAT_LOST if outputs.age_ns(now_ns) > self._lost_ns[OUTPUTS]
            else Reason.NONE
        )  # fmt: skip
        for name in self._plain:
            held, dead = (inputs, gateway_dead) if name in inputs.shape.index else (outputs, plc_dead)
            if held.counter:
                value = held.value(name)
                self._value(
                    name, replace(value, quality=Quality.BAD, reason=dead) if dead else value, now_ms, offset_ns
                )
        if outputs.counter:
            self._controller(plc_dead, outputs, now_ms, offset_ns)
        for tag, messages in inputs.messages.items():
            for message in messages:
                data = COMMAND(message.data) if tag.endswith(".inbox") else RESPONSE(message.data)
                kind = Kind.COMMAND if tag.endswith(".inbox") else Kind.PAYLOAD
                self.share(kind, tag, data, (message.t_ns + offset_ns) // NS_PER_MS)
        for tag, messages in outputs.messages.items():
            if tag.endswith(".outbox"):
                for message in messages:
                    self.share(Kind.PAYLOAD, tag, RESPONSE(message.data), (message.t_ns + offset_ns) // NS_PER_MS)

    def _controller(self, dead: Reason, outputs: Snapshot, now_ms: int, offset_ns: int) -> None:
        """Share whether the PLC's programs run, and the states of running ones."""
        runs = TagValue(not dead, Quality.BAD if dead else Quality.GOOD, dead, outputs.t_ns)
        for program in self._programs:
            self._value(program, runs, now_ms, offset_ns)
        if dead:
            self.share_again()
            return
        for program, period in self._machines.items():
            self._status(program, outputs.value(f"{program}.state"), outputs.value(period), now_ms)

    def share_again(self) -> None:
        """Share the states again with the next `look`, because the sender of a refused command assumes a wrong state."""
        for program in self._machines:
            self._said.pop(f"{program}.", None)

    def _value(self, name: str, value: TagValue, now_ms: int, offset_ns: int) -> None:
        what = (value.value, value.quality, value.reason)
        if self._due(name, what, now_ms) and not self._too_soon(name, what, now_ms):
            fresh = value.t_ns and value.good and self._said.get(name, (None, 0))[0] != what
            self._said[name] = (what, now_ms)
            self.share(Kind.VALUE, name, value, (value.t_ns + offset_ns) // NS_PER_MS if fresh else now_ms)

    def _status(self, program: str, state: TagValue, period: TagValue, now_ms: int) -> None:
        if (
            not isinstance(state.value, int)
            or not isinstance(period.value, int | float)
            or isinstance(state.value, bool)
        ):
            return
        name = next((n for n, code in STATE_CODES.items() if code == state.value), "")
        what = (name, int(period.value))
        if name and self._due(f"{program}.", what, now_ms):
            self._said[f"{program}."] = (what, now_ms)
            self.share(Kind.STATE, program, encode_status(*what), now_ms)

    def _too_soon(self, name: str, what: tuple[object, ...], now_ms: int) -> bool:
        said, at_ms = self._said.get(name, (None, 0))
        return isinstance(said, tuple) and said[1:] == what[1:] and now_ms - at_ms < self._every_ms

    def _due(self, name: str, what: object, now_ms: int) -> bool:
        said, at_ms = self._said.get(name, (None, 0))
        return said != what or now_ms - at_ms >= REFRESH_MS


class PlantThread:
    """The process: reads the image, writes the store and sends, until it is stopped."""

    def __init__(self, config: PlantThreadConfig) -> None:
        self._config = config
        self._clock = WallClock()
        self._stop = asyncio.Event()
        self._place = ""

    async def run(self) -> int:
        c, clock = self._config, self._clock
        [system] = read_resolved(c.resolved)
        assert isinstance(system, System)
        layout = layout_in(Path(c.run_dir), system)
        async with AsyncExitStack() as stack:
            store = await open_knowledge(c.store)
            stack.push_async_callback(store.aclose)
            origin = await store.own("plant", system=system.name, prototype=c.prototype, log=secrets.token_hex(4))
            if delegated := delegated_transmitter(c.place, system):
                audit = AuditLog(Path(c.run_dir) / "audit.jsonl", clock)
                stack.callback(audit.close)
                audit.note("lend", delegated, by="digital thread", result="the thread uses its mailboxes")
            connector: Connector = OsConnector()
            if c.mapping is not None:
                connector = MappedConnector(connector, mapping_from_json(c.mapping))
            carrier, self._place = await plant_carrier(c.place, system, clock, connector)
            stack.push_async_callback(carrier.aclose)
            least_s, most_s = system.commands.period_s
            bounds = CommandLimits(least_s, most_s, system.commands.per_minute)
            self._gate = CommandGate(
                remote=system.remote == "remote", bounds=bounds, clock=clock, since_ms=await self._since(store, origin)
            )
            self._end = ThreadEnd(
                store, carrier, schema_of(system), clock,
                origin=origin, prototype=c.prototype, on_events=self._commanded,
            )  # fmt: skip
            self._writer = KnowledgeWriter(
                store, origin, clock, on_written=self._end.appended, make_room=self._end.make_room
            )
            self._process = ImageProcess(system, layout, clock, c.every_ms)
            connection = PTtoDTConnection(self._end, [self._process, self._gate], self._writer, clock)
            image = stack.enter_context(attached(layout, Path(c.run_dir) / "image"))
            readers = image.reader(INPUTS), image.reader(OUTPUTS)
            async with Nursery() as nursery:
                nursery.start(self._end.run(), "thread")
                nursery.start(self._writer.run(), "knowledge")
                watching = nursery.start(self._look(connection, readers), "image")
                await self._serve(nursery)
                watching.cancel()
                connection.pump()
                await self._writer.flush()
        return 0

    async def _since(self, store: KnowledgeStore, origin: str) -> int:
        """Return when this log began (UTC, ms); 0 if its beginning has been forgotten."""
        first = await store.read(origin, 1, 1)
        if first:
            return first[0].t_ms if first[0].sequence == 1 else 0
        return self._clock.utc_ns() // NS_PER_MS

    async def _commanded(self, origin: str, events: Sequence[Event]) -> None:
        """Pass each command from the digital twin's log to the gateway, if the gate admits it. Each number arrives once."""
        for event in events:
            if event.kind != Kind.COMMAND:
                continue
            try:
                client = await ControlClient.connect_unix(Path(self._config.run_dir) / "gateway.sock")
                try:
                    await self._hand_over(client, origin, event)
                finally:
                    await client.aclose()
            # not tried again, because a command applies to the moment at which it was sent
            except FieldtwinError as e:
                self._gate.share(Kind.REFUSAL, "gateway", f"number {event.sequence} of {origin}: {e}")

    async def _hand_over(self, client: ControlClient, origin: str, event: Event) -> None:
        """Pass a command to the gateway.

        The switch and the limits are read from the gateway, because a reload may have changed them.
        """
        now = await client.call("gate")
        least_s, most_s = now["period_s"]
        self._gate.restate(remote=now["remote"], bounds=CommandLimits(least_s, most_s, now["per_minute"]))
        command = self._gate.admit(origin, event)
        if command is None:
            self._process.share_again()
            return
        if not (await client.call("command", payload=command.data.hex(), by=origin))["taken"]:
            self._gate.share(
                Kind.REFUSAL, "gateway", f"number {event.sequence} of {origin}: the plant is switched to local"
            )
            self._process.share_again()

    async def _look(self, connection: PTtoDTConnection, readers: Any) -> None:
        inputs, outputs = readers
        while True:
            self._process.look(inputs.snapshot(), outputs.snapshot())
            connection.pump()
            await self._clock.sleep_until_ns(self._clock.monotonic_ns() + LOOK_MS * NS_PER_MS)

    async def _serve(self, nursery: Nursery) -> None:
        socket = Path(self._config.run_dir) / "thread.sock"
        server = ControlServer({"ready": self._ready, "get": self._get, "stop": self._request_stop})
        await server.listen_unix(socket)
        on_stop_signal(self._stop.set)
        failing = asyncio.ensure_future(nursery.wait())
        stopping = asyncio.ensure_future(self._stop.wait())
        try:
            await asyncio.wait([failing, stopping], return_when=asyncio.FIRST_COMPLETED)
            if failing.done():
                failing.result()
        finally:
            failing.cancel()
            stopping.cancel()
            await server.aclose()
            socket.unlink(missing_ok=True)

    async def _ready(self, args: dict[str, Any]) -> dict[str, Any]:
        return {"ready": True, "pid": os.getpid()}

    async def _get(self, args: dict[str, Any]) -> PlantThreadStatus:
        return PlantThreadStatus(
            place=self._place,
            **msgspec.structs.asdict(self._end.status()),
            written=self._writer.written,
            dropped=self._writer.dropped,
            store_trouble=self._writer.trouble,
            commands_taken=self._gate.taken,
            commands_refused=self._gate.refused,
        )

    async def _request_stop(self, args: dict[str, Any]) -> PlantThreadStatus:
        status = await self._get(args)
        asyncio.get_running_loop().call_later(0.05, self._stop.set)
        return status


def main(argv: list[str]) -> int:
    """Run the process; an error is printed to stderr as one line."""
    return child_main(argv, PlantThreadConfig, lambda config: PlantThread(config).run())


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
