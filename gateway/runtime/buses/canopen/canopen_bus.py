"""One CAN bus: its connection, the CANopen master on it, and the boot-up procedure of its nodes.

Every node is brought up separately, and again whenever it restarts or was lost: identity, configuration, start, in the order of
CiA 302-2. If no node has an expected node ID, the master assigns it over LSS, provided that the system file gives the node's LSS
address. A node that is up is polled over SDO for the values that no TPDO carries, and receives its outputs (`node_writes`).
Configuring, starting, SYNC, TIME, LSS and outputs are writes: on a plant where writing is not allowed, the gateway only listens
and reads.
"""

from __future__ import annotations

import asyncio
from collections import Counter, deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict

from msgspec.structs import replace

from fieldtwin.gateway.core.clock import NS_PER_MS, NS_PER_S, Clock
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.connection import Connector
from fieldtwin.gateway.core.errors import (
    ConnectionLost,
    FieldtwinError,
    NotAllowed,
    ReplyTimeout,
    Unreachable,
    UsageError,
)
from fieldtwin.gateway.core.histogram import response_times
from fieldtwin.gateway.core.values import COMMAND, Reason
from fieldtwin.gateway.devices.canopen_config import cycle_period_ns
from fieldtwin.gateway.devices.canopen_device import CanopenDriver
from fieldtwin.gateway.devices.canopen_rpdo import Rpdo
from fieldtwin.gateway.devices.config import BusConfig
from fieldtwin.gateway.protocols.canopen.cob_id import LSS_REPLY
from fieldtwin.gateway.protocols.canopen.emcy import parse_emcy
from fieldtwin.gateway.protocols.canopen.lss.master import LssMaster
from fieldtwin.gateway.protocols.canopen.master import CanopenMaster
from fieldtwin.gateway.protocols.canopen.nmt.states import NmtState, NodeEvent, conflict_text
from fieldtwin.gateway.protocols.canopen.pdo.sync_watch import SyncWatch
from fieldtwin.gateway.runtime.audit_log import AuditLog
from fieldtwin.gateway.runtime.buses.backoff import Backoff
from fieldtwin.gateway.runtime.buses.bus import MOST_LOCALS, Ended, status_of
from fieldtwin.gateway.runtime.buses.canopen.boot import assign, bring_up
from fieldtwin.gateway.runtime.buses.canopen.node_status import NodeStatus, device_status
from fieldtwin.gateway.runtime.buses.canopen.node_writes import Done, InOrder, NodeWrites
from fieldtwin.gateway.runtime.buses.canopen.producing import Producing
from fieldtwin.gateway.runtime.buses.pending_config import PendingConfig
from fieldtwin.gateway.runtime.buses.poll_schedule import PollSchedule, rates_of
from fieldtwin.gateway.runtime.buses.reasons import reason_of
from fieldtwin.gateway.runtime.gateway_status import BusStatus, DeviceStatus
from fieldtwin.gateway.runtime.tags import TagTable

SETTLE_NS = 100 * NS_PER_MS
"""A TPDO or reply that is received at least this long after an RPDO shows whether the RPDO took effect."""


def _nobody(driver: CanopenDriver) -> None:
    pass


START_AGAIN_S = 2.0
"""Delay in seconds between a node's leaving OPERATIONAL by itself and the next start."""


class CanopenBus:
    """A CAN bus that runs until cancelled.

    `on_offline` is called with the driver of a node that was lost, or that may have lost its commanded values because
    it restarted or left OPERATIONAL.
    """

    def __init__(
        self,
        config: BusConfig,
        drivers: list[CanopenDriver],
        connector: Connector,
        clock: Clock,
        tags: TagTable,
        audit: AuditLog,
        allow_writes: bool,
        on_offline: Callable[[CanopenDriver], None] = _nobody,
    ) -> None:
        self.config = config
        self.nodes = {d.node: self._status(d, drivers, clock) for d in drivers}
        self._by_name = {status.driver.config.name: status for status in self.nodes.values()}
        self.connected = False
        self.opens = 0
        self.locals: deque[str] = deque(maxlen=MOST_LOCALS)
        """The local addresses of the connections so far, latest last; an empty text for a medium without addresses."""
        self.error = ""
        self._coming: PendingConfig | None = None
        self._nursery: Nursery | None = None
        self._stopping = False
        self._producing = Producing(clock)
        self.sync_watch = SyncWatch()
        self._connector = connector
        self._clock = clock
        self._tags = tags
        self._audit = audit
        self._allow_writes = allow_writes
        self._on_offline = on_offline
        self._master: CanopenMaster | None = None
        self._lss: LssMaster | None = None
        self.latency = response_times()
        self._past: Counter[str] = Counter()

    def _status(self, driver: CanopenDriver, drivers: list[CanopenDriver], clock: Clock) -> NodeStatus:
        schedule = PollSchedule(rates_of([d.config for d in drivers])[driver.config.name], ())
        return NodeStatus(driver, NodeWrites(driver, clock, self.config.timeout_s), schedule)

    def reconfigure(self, coming: PendingConfig) -> None:
        """Take over a new configuration between two polls: each node's part when no group of it is being read."""
        self._coming = coming
        for status in self.nodes.values():
            if not status.reading:
                self._take_over(status)
                if status.polling is not None and self._nursery is not None:
                    status.polling.cancel()  # the task may sleep until the time of a poll that no longer exists
                    status.polling = self._nursery.start(self._poll(status), f"{status.driver.config.name} polls")
        self._taken_over()

    def _take_over(self, status: NodeStatus) -> None:
        coming, driver = self._coming, status.driver
        assert coming is not None
        new = coming.devices[driver.config.name]
        if driver.config is not new:
            rates = rates_of(list(coming.devices.values()))[new.name]
            driver.reconfigure(new)
            status.backoff.restate(new.backoff_first_s, new.backoff_limit_s)
            status.schedule.restate(rates, new.phase, self._clock.monotonic_ns(), there=status.online)
            coming.taken(driver)

    def _taken_over(self) -> None:
        coming = self._coming
        if coming is not None and all(
            s.driver.config is coming.devices[s.driver.config.name] for s in self.nodes.values()
        ):
            self.config, self._coming = coming.bus, None
            coming.done.set()

    # -- status and requests ------------------------------------------------------------------------------------------

    @property
    def not_produced(self) -> int:
        """Return the number of SYNC, TIME and repeated RPDO messages that were not sent.

        The bus did not take them in time, or their time passed while the gateway did not run."""
        return self._producing.not_produced + sum(status.writes.not_sent for status in self.nodes.values())

    def takes(self, device: str, tag: str) -> bool:
        """Return whether a write of this tag can be sent now: the node is up, and also OPERATIONAL if the tag goes by
        RPDO."""
        status = self._by_name[device]
        driver = status.driver
        if not status.online or self._master is None:
            return False
        if driver.rpdo_of(tag) is not None:
            return driver.operational
        return self._master.node_state(driver.node) is not NmtState.STOPPED  # a stopped node answers no SDO (7.3.2.2)

    def frame_of(self, device: str, tag: str) -> Rpdo | None:
        """Return the RPDO that carries this tag together with others, or None for a tag that is written by itself."""
        return self._by_name[device].driver.rpdo_of(tag)

    def settle_ns(self, device: str, tag: str) -> int:
        """Return how long after a write the node may still report the previous value, in ns."""
        rpdo = self.frame_of(device, tag)
        if rpdo is None:
            return SETTLE_NS
        return SETTLE_NS + (2 * self.config.canopen.sync_ms * NS_PER_MS if rpdo.synchronous else 0)

    def unrequested(self, device: str, tag: str) -> bool:
        """Return whether a TPDO of the node carries this tag."""
        return f"{device}.{tag}" in self._by_name[device].driver.pdo_tags

    def write(self, device: str, writes: Sequence[tuple[str, COMMAND]], ended: Ended) -> None:
        """Start to write tags of one node. Tags of one RPDO are sent in one frame; see `Bus`."""
        driver = self._by_name[device].driver
        InOrder(driver, writes, self._write, ended).next()

    def _write(self, driver: CanopenDriver, tag: str, command: COMMAND, done: Done) -> None:
        if not self._allow_writes:
            done(NotAllowed("this plant is read-only", where=driver.config.where))
        elif not self.takes(driver.config.name, tag):
            done(Unreachable("the node takes nothing now", where=driver.config.where))
        else:
            self.nodes[driver.node].writes.write(tag, command, done)

    def totals(self) -> Counter[str]:
        """Return counters over all connections so far."""
        return self._past + Counter(asdict(self._master.counters)) if self._master else Counter(self._past)

    def status(self) -> BusStatus:
        return replace(status_of(self), not_produced=self.not_produced, sync_producers=self.sync_watch.verdict)

    def device_statuses(self, now_ns: int) -> dict[str, DeviceStatus]:
        return {
            node.driver.config.name: device_status(node, self.config.name, self._unstarted(node), now_ns)
            for node in self.nodes.values()
        }

    def _unstarted(self, status: NodeStatus) -> str:
        """Return which tags have no value because the gateway does not start the node; empty if it is started."""
        driver = status.driver
        if not status.online or self._master is None or (self._allow_writes and driver.config.start):
            return ""
        if not (tags := driver.unreceived_tags):
            return ""
        why = "the system file has no `start: true`" if self._allow_writes else "a read-only plant starts no node"
        state = self._master.node_state(driver.node)
        is_in = f"is in {state.name.replace('_', '-')}" if state is not None else "has sent no heartbeat"
        return f"the node {is_in} and sends no TPDO with {', '.join(tags)}; {why}: another NMT master must start it"

    # -- running --------------------------------------------------------------------------------------------------------

    async def run(self) -> None:
        """Open the connection, serve, and open it again, until cancelled."""
        backoff = Backoff(0.25, 5.0)
        for status in self.nodes.values():
            status.schedule.anchor(self._clock.monotonic_ns())
        while True:
            try:
                connection = await self._connector.open_can(self.config.endpoint, self.config.bitrate)
            except (
                Unreachable,
                UsageError,
            ) as e:  # a user can correct a wrong bit rate while the gateway runs, so keep trying
                self._lost(e)
                await self._pause(backoff.next_s())
                continue
            master = CanopenMaster(
                connection,
                self._clock,
                sdo_timeout_s=self.config.timeout_s,
                sdo_retries=self.config.retries,
                sdo_transfer_s=self.config.canopen.sdo_transfer_s,
                short_sdo=self.config.canopen.short_sdo,
                on_event=self._on_event,
            )
            master.latency = self.latency
            self._master, self._lss = master, LssMaster(master.send, self._clock)
            master.listen(LSS_REPLY, self._lss.on_reply)
            if not self.sync_watch.verdict:
                produces = bool(self.config.canopen.sync_ms and self._allow_writes)
                nodes = [status.driver.config.canopen for status in self.nodes.values()]
                self.sync_watch = SyncWatch(own=produces, period_ns=cycle_period_ns(self.config.canopen, nodes))
            master.on_sync = self.sync_watch.feed
            self.connected, self.error = True, ""
            self.locals.append(connection.local)
            self.opens += 1
            try:
                async with Nursery() as nursery:
                    self._nursery = nursery
                    nursery.start(master.run(), f"{self.config.name} master")
                    for status in self.nodes.values():
                        status.driver.attach_master(connection, master)
                        status.wanted.set()
                        name = status.driver.config.name
                        nursery.start(self._keep_up(status), f"{name} bring-up")
                        nursery.start(status.writes.run_downloads(), f"{name} downloads")
                        nursery.start(status.writes.run_rpdos(), f"{name} RPDOs")
                        if status.driver.config.tpdo1 is not None and not self._allow_writes:
                            nursery.start(self._poll_unmapped(status), f"{name} tags without a TPDO")
                        if status.driver.config.poll:
                            status.polling = nursery.start(self._poll(status), f"{name} polls")
                    for producer in self._producing.producers(self.config.canopen) if self._allow_writes else ():
                        nursery.start(self._producing.run(producer, master), f"{self.config.name} {producer.name}")
                    backoff.reset()
                    await nursery.wait()
            except ConnectionLost as e:
                self._lost(e)
                await self._pause(backoff.next_s())
            finally:
                self._past.update(asdict(master.counters))
                self._master = self._lss = self._nursery = None
                for status in self.nodes.values():
                    status.polling, status.reading = None, False
                    if self._coming is not None:
                        self._take_over(status)
                self._taken_over()
                self.connected = False
                await connection.aclose()

    async def _pause(self, seconds: float) -> None:
        await self._clock.sleep_until_ns(self._clock.monotonic_ns() + int(seconds * NS_PER_S))

    def _lost(self, error: FieldtwinError) -> None:
        self.connected, self.error = False, str(error)
        for status in self.nodes.values():
            self._offline(status, error)
            self._tags.put_bad(status.driver.tag_names, Reason.UNREACHABLE)

    def _offline(self, status: NodeStatus, error: FieldtwinError) -> None:
        """Mark a node as away, or as having lost its configuration. Pending writes to it fail with `error`."""
        status.online, status.error = False, str(error)
        status.up.clear()
        status.schedule.stop()
        status.writes.fail(error)
        self._on_offline(status.driver)

    def _online(self, status: NodeStatus) -> None:
        driver = status.driver
        for tag in driver.profile.tags.values():
            if tag.readable:  # only now the gateway knows which tags a TPDO carries, and when the node sends it
                self._tags.declare([f"{driver.config.name}.{tag.name}"], driver.stale_after_ms(tag))
        self._tags.put_bad([f"{driver.config.name}.{tag}" for tag in driver.unreceived_tags], Reason.NOT_OPERATIONAL)
        status.online, status.error = True, ""
        status.bring_ups += 1
        status.backoff.reset()
        status.schedule.start(self._clock.monotonic_ns())
        status.up.set()

    async def _keep_up(self, status: NodeStatus) -> None:
        """Check, configure and start the node now, and again whenever `status.wanted` is set, until cancelled."""
        while True:
            await status.wanted.wait()
            status.wanted.clear()
            status.booted.clear()
            try:
                await bring_up(status.driver, self._audit, self._allow_writes)
            except ReplyTimeout as e:
                self._failed(status, await self._assigned(status.driver, e))
                await self._rest(status)
            except ConnectionLost:
                raise
            except FieldtwinError as e:
                self._failed(status, e)
                await self._rest(status)
            else:
                if not status.wanted.is_set():  # otherwise the node restarted meanwhile
                    self._online(status)

    async def _rest(self, status: NodeStatus) -> None:
        """Wait for the back-off time after a node did not answer, or until its boot-up message arrives."""
        with suppress(TimeoutError):
            async with asyncio.timeout(status.backoff.next_s()):
                await status.booted.wait()

    async def _poll(self, status: NodeStatus) -> None:
        """Read the node's groups when they are due, while it is up. Missed periods are counted and skipped."""
        schedule = status.schedule
        while True:
            await status.up.wait()
            group, due_ns = min(schedule.due_ns.items(), key=lambda item: item[1])
            now_ns = self._clock.monotonic_ns()
            if due_ns > now_ns:
                await self._clock.sleep_until_ns(due_ns)
                continue
            schedule.took(group, now_ns)
            status.reading = True
            await self._read_group(status, group)
            status.reading = False
            if self._coming is not None:
                self._take_over(status)
                self._taken_over()

    async def _poll_unmapped(self, status: NodeStatus) -> None:
        """Read over SDO the tags of a `tpdo1` that was not written, because on a read-only plant no TPDO may carry them."""
        driver = status.driver
        while True:
            await status.up.wait()
            if driver.unmapped and driver.master.node_state(driver.node) is not NmtState.STOPPED:
                try:
                    await driver.read_unmapped()
                except ConnectionLost:
                    raise
                except FieldtwinError as e:
                    status.poll_errors += 1
                    self._tags.put_bad([f"{driver.config.name}.{name}" for name in driver.unmapped], reason_of(e))
            await self._clock.sleep_until_ns(self._clock.monotonic_ns() + driver.unmapped_ms * NS_PER_MS)

    async def _read_group(self, status: NodeStatus, group: str) -> None:
        driver, master = status.driver, status.driver.master
        if master.node_state(driver.node) is NmtState.STOPPED:
            return  # a stopped node answers no SDO (7.3.2.2): the values become stale
        status.polls += 1
        try:
            await driver.receive(group)
        except ConnectionLost:
            raise
        except FieldtwinError as e:
            status.poll_errors += 1
            brought = driver.pdo_tags
            names = [f"{driver.config.name}.{t.name}" for t in driver.profile.group(group)]
            self._tags.put_bad([name for name in names if name not in brought], reason_of(e))
            if status.online and not driver.is_watched:
                self._failed(status, e)  # without a heartbeat, only this error shows that the node is lost

    def _failed(self, status: NodeStatus, error: FieldtwinError) -> None:
        self._offline(status, error)
        self._tags.put_bad(status.driver.tag_names, reason_of(error))
        status.wanted.set()

    async def _assigned(self, driver: CanopenDriver, error: FieldtwinError) -> FieldtwinError:
        """Assign the node ID of a node that did not answer; return the error as `assign` does."""
        if self._lss is None or not self._allow_writes:
            return error
        return await assign(driver, self._lss, self._audit, error)

    def _restate_limits(self, driver: CanopenDriver) -> None:
        """Set the age limits of the node's values again, because they depend on whether its heartbeat is received."""
        for tag in driver.profile.tags.values():
            if tag.readable:
                self._tags.restate(f"{driver.config.name}.{tag.name}", driver.stale_after_ms(tag))

    def _on_event(self, event: NodeEvent) -> None:
        status = self.nodes.get(event.node)
        if status is None:
            return
        status.driver.on_event(event)
        if event.kind == "state" and status.online and status.driver.config.heartbeat is not None:
            self._restate_limits(status.driver)  # monitoring starts with the first heartbeat
        if event.kind == "boot-up":
            status.boots += 1
            status.emcy_log.restarted()
            self._offline(status, Unreachable("the node restarted"))
            status.wanted.set()
            status.booted.set()
        elif event.kind == "heartbeat-lost":
            self._offline(status, Unreachable("heartbeat lost"))
            status.wanted.set()
        elif event.kind == "state" and event.state is not NmtState.OPERATIONAL:
            self._on_offline(status.driver)  # in that case the node alone controls its outputs
            if event.state is NmtState.PRE_OPERATIONAL and status.online and status.driver.config.start:
                self._start_again(status)
        elif event.kind == "conflict":
            status.conflicts += 1
            status.conflict = conflict_text(event)
        elif event.kind == "emcy":
            status.emcy_log.add(parse_emcy(event.data), event.t_ns)

    def _start_again(self, status: NodeStatus) -> None:
        """Start a node again that left OPERATIONAL by itself, as object 1029h prescribes after an error (CiA 301, 7.5.2.32).

        The node is brought up again after `START_AGAIN_S` if it is still PRE-OPERATIONAL then. The delay prevents continuous
        restarts of a node with a lasting error.
        """
        master, node = self._master, status.driver.node

        def again() -> None:
            if master is None or master is not self._master or self._stopping or not status.online:
                return
            if master.node_state(node) is NmtState.PRE_OPERATIONAL:
                self._offline(status, Unreachable("the node left OPERATIONAL"))
                status.wanted.set()

        if self._allow_writes and not self._stopping:
            if status.start_again is not None:
                status.start_again.cancel()  # the node was started meanwhile, and left OPERATIONAL again
            status.start_again = asyncio.get_running_loop().call_later(START_AGAIN_S, again)

    async def halt(self, timeout_s: float) -> None:
        """Stop sending requests, so that the counters stay as they are, and put the nodes that the gateway started back to
        PRE-OPERATIONAL, so that they send no process data.

        The requests under way, and then each node, may take `timeout_s` seconds."""
        self._stopping = True
        if self._master is None:
            return
        await self._master.end_transfers(timeout_s)
        if self._master is None or not self._allow_writes:
            return
        for status in self.nodes.values():
            if status.online and status.driver.config.start:
                name = status.driver.config.name
                with suppress(Unreachable):  # an audit log that cannot be written must not prevent the stop
                    self._audit.note("nmt", name, by="stop", result="asked", what="pre-operational")
                try:
                    async with asyncio.timeout(timeout_s):
                        status.driver.consumer.observe(COMMAND(b"", "nmt_preoperational"))
                        await status.driver.send()
                except (TimeoutError, FieldtwinError) as e:
                    status.error = f"not stopped: {e}"
