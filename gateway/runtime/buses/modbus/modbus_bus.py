"""One Modbus bus: its connection, its queue and the polls of its devices.

The bus carries one transaction at a time. Writes go first; then polls that are due and the requests of bridge clients alternate.
While one unit ID has its pause after a transaction, the bus serves other units.

A device that does not answer delays the other devices by its full timeouts only once. After that it is probed with single
requests, after growing pauses. While other devices answer, all probes together get at most a configured share of the bus's time
(case MB-062). This module opens connections only through the `Connector`. A lost connection is opened again
without limit, with back-off; until then the devices' tags are bad and carry the reason.
"""

from __future__ import annotations

import asyncio
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import partial

from fieldtwin.gateway.core.clock import NS_PER_S, Clock
from fieldtwin.gateway.core.concurrency.wakeup import Wakeup
from fieldtwin.gateway.core.connection import Connector
from fieldtwin.gateway.core.errors import (
    ConnectionLost,
    DeviceRefused,
    EndpointBusy,
    FieldtwinError,
    ReplyTimeout,
    Unreachable,
    WireError,
    WrongDevice,
)
from fieldtwin.gateway.core.histogram import response_times
from fieldtwin.gateway.core.values import COMMAND
from fieldtwin.gateway.devices.config import BusConfig
from fieldtwin.gateway.devices.register_device import RegisterDriver, WriteProgress
from fieldtwin.gateway.devices.transmitter import TransmitterDriver
from fieldtwin.gateway.protocols.modbus.client import ModbusClient
from fieldtwin.gateway.protocols.modbus.frames.selection import framing_of
from fieldtwin.gateway.protocols.modbus.requests.refusals import Acknowledged, GatewayRefusal, ServerBusy
from fieldtwin.gateway.runtime.buses.backoff import Backoff
from fieldtwin.gateway.runtime.buses.bus import MOST_LOCALS, Ended, not_sent, status_of
from fieldtwin.gateway.runtime.buses.modbus.bridge_queue import BridgeQueue
from fieldtwin.gateway.runtime.buses.modbus.bus_turns import DeviceState, Turns, restate, states_of
from fieldtwin.gateway.runtime.buses.modbus.device_requests import DeviceRequests
from fieldtwin.gateway.runtime.buses.modbus.jobs import BusJob, JobQueue
from fieldtwin.gateway.runtime.buses.modbus.patience import Patience
from fieldtwin.gateway.runtime.buses.modbus.unanswered import MOST_UNANSWERED, Unanswered
from fieldtwin.gateway.runtime.buses.pending_config import PendingConfig
from fieldtwin.gateway.runtime.buses.poll_schedule import rates_of
from fieldtwin.gateway.runtime.buses.reasons import reason_of
from fieldtwin.gateway.runtime.gateway_status import BusStatus, DeviceStatus
from fieldtwin.gateway.runtime.tags import TagTable

STREAMS = frozenset({"tcp", "tls", "rtu+tcp"})


class ModbusBus:
    """A Modbus bus that runs until cancelled. `on_offline` is called with the driver of a device that was lost.

    `offset`, 0 to less than 1, shifts the phases of this bus's polls, so that the buses of one gateway do not all poll at the
    same time.
    """

    def __init__(
        self,
        config: BusConfig,
        drivers: list[RegisterDriver],
        connector: Connector,
        clock: Clock,
        tags: TagTable,
        on_offline: Callable[[RegisterDriver], None],
        offset: float = 0.0,
    ) -> None:
        self.config = config
        self.devices = states_of(drivers, offset)
        self._by_name = {device.driver.config.name: device for device in self.devices}
        self.connected = False
        self.opens = 0
        self.locals: deque[str] = deque(maxlen=MOST_LOCALS)
        """The local addresses of the connections so far, latest last; an empty text for a medium without addresses."""
        self.error = ""
        self.down: FieldtwinError | None = None
        """The error of the last attempt to open the bus. None while the bus is open, and after a loss until the next attempt
        has failed.
        """
        self._wakeup = Wakeup(clock)
        self.guests = BridgeQueue()
        self.guests.on_put = self._wakeup.wake
        self._bridge_request_was_last = False
        line = config.endpoint
        t35_ns = round(3.5 * line.serial.char_time_s * NS_PER_S) if line.is_serial else 0
        self._turns = Turns(self.devices, config.probe_share, t35_ns)
        self._connector = connector
        self._clock = clock
        self._tags = tags
        self._on_offline = on_offline
        self._offset = offset
        self._coming: PendingConfig | None = None
        self._jobs = JobQueue()
        self._idle = asyncio.Event()
        self._halted = False
        self.latency = response_times()
        self._patience = Patience(config, self._turns, self.latency)
        self._requests = DeviceRequests(config, clock, tags)
        self._past: Counter[str] = Counter()
        self._client: ModbusClient | None = None

    # -- status and requests ------------------------------------------------------------------------------------------

    def online(self, driver: RegisterDriver) -> bool:
        """Return whether the device answers and is the expected one."""
        return any(d.driver is driver and d.online for d in self.devices)

    def takes(self, device: str, tag: str) -> bool:
        """Return whether a write of this tag can be sent now; see `Bus`."""
        state = self._by_name.get(device)
        return state is not None and state.online

    def frame_of(self, device: str, tag: str) -> None:
        """Return None, because registers have no frame that they always share; see `Bus`."""

    def settle_ns(self, device: str, tag: str) -> int:
        """Return 0: a server answers a write after it took effect; see `Bus`."""
        return 0

    def unrequested(self, device: str, tag: str) -> bool:
        """Return False: a Modbus server sends nothing without a request; see `Bus`."""
        return False

    def write(self, device: str, writes: Sequence[tuple[str, COMMAND]], ended: Ended) -> None:
        """Start to write tags of one device: adjacent registers with one request; see `Bus`."""
        driver = self._by_name[device].driver
        if len(writes) == 1:
            [(tag, command)] = writes
            driver.consumer.observe(command)
            self.submit(BusJob(driver, driver.send, partial(ended, tag)))
            return
        progress = WriteProgress()

        def done(error: FieldtwinError | None) -> None:
            for tag, _ in writes:
                if tag in progress.confirmed:
                    ended(tag, None)
                else:
                    unsent = bool(progress.sent) and tag not in progress.sent
                    ended(tag, not_sent(driver.config.where) if unsent else error)

        commands = [command for _, command in writes]
        self.submit(BusJob(driver, partial(driver.write_together, commands, progress), done))

    def submit(self, job: BusJob) -> None:
        """Queue a job ahead of all polls. If the queue is full or there is no connection, the job fails immediately."""
        if not self.connected:
            job.done(Unreachable(f"not connected: {self.error}", where=f"{self.config.name} {self.config.endpoint}"))
        elif self._jobs.full:
            job.done(EndpointBusy("the bus has no room for another request", where=self.config.name))
        else:
            self._jobs.add(job)
            self._wakeup.wake()

    def reconfigure(self, coming: PendingConfig) -> None:
        """Take over a new configuration between two polls: each device's part when no group of it is being read."""
        self._coming = coming
        if self._client is None:
            self._take_over()
        self._wakeup.wake()

    def _take_over(self) -> None:
        coming, now_ns = self._coming, self._clock.monotonic_ns()
        assert coming is not None
        config = self.config = coming.bus
        self._turns.restate(config.probe_share)
        self._patience.restate(config)
        self._requests.restate(config)
        if self._client is not None:
            self._client.restate(
                timeout_s=config.timeout_s, turnaround_s=config.turnaround_s, spacing_s=config.spacing_s
            )
        rates = rates_of([coming.devices[d.driver.config.name] for d in self.devices], self._offset)
        for device in self.devices:
            driver = device.driver
            new = coming.devices[driver.config.name]
            if device.reading is None and driver.config is not new:
                restate(device, new, rates[new.name], now_ns)
                coming.taken(driver)
        if all(d.driver.config is coming.devices[d.driver.config.name] for d in self.devices):
            self._coming = None
            coming.done.set()

    def totals(self) -> Counter[str]:
        """Return counters over all connections so far: requests, replies, timeouts and so on. `missed_polls` counts the
        periods in which a group of an online device was not read."""
        totals = self._past + Counter(asdict(self._client.counters)) if self._client else Counter(self._past)
        totals["missed_polls"] = sum(sum(d.schedule.missed.values()) for d in self.devices)
        return totals

    def status(self) -> BusStatus:
        return status_of(self)

    def device_statuses(self, now_ns: int) -> dict[str, DeviceStatus]:
        return {
            state.driver.config.name: DeviceStatus(
                bus=self.config.name,
                address=state.driver.config.address,
                online=state.online,
                error=state.error,
                identity_error=state.driver.identity_error,
                polls=state.polls,
                errors=state.poll_errors,
                samples_missed=state.driver.samples_missed,
                mailbox=isinstance(state.driver, TransmitterDriver),
            )
            for state in self.devices
        }

    async def halt(self, timeout_s: float) -> None:
        """Stop sending. Return when the present request has ended, or after `timeout_s` seconds."""
        self._halted = True
        self._wakeup.wake()
        if self._client is not None:
            try:
                async with asyncio.timeout(timeout_s):
                    await self._idle.wait()
            except TimeoutError:
                pass  # a slow device must not prevent the end of the process

    # -- running --------------------------------------------------------------------------------------------------------

    async def run(self) -> None:
        """Open the connection, serve, and open it again, until cancelled."""
        backoff = Backoff(0.25, 5.0)
        endpoint = self.config.endpoint
        epoch_ns = self._clock.monotonic_ns()
        for device in self.devices:
            device.schedule.anchor(epoch_ns)
        while True:
            if self._coming is not None:
                self._take_over()
            config = self.config
            try:
                connection = await self._connector.open_bytes(endpoint)
            except Unreachable as e:
                self.down = e
                self._lost(e)
                self.guests.fail_all(e)
                await self._pause(backoff.next_s())
                continue
            client = ModbusClient.at(
                endpoint,
                connection,
                self._clock,
                timeout_s=config.timeout_s,
                echo=config.echo,
                strict=config.strict,
                turnaround_s=config.turnaround_s,
                spacing_s=config.spacing_s,
            )
            client.latency = self.latency
            self._client = client
            self.connected, self.error, self.down = True, "", None
            self.locals.append(connection.local)
            self.opens += 1
            try:
                for device in self.devices:
                    device.driver.attach_client(connection, client)
                    device.next_try_ns, device.tried = 0, False
                if config.connect_pause_s:
                    await self._pause(config.connect_pause_s)
                await self._serve(client, backoff)
            except ConnectionLost as e:
                self._lost(e)
                await self._pause(backoff.next_s())
            finally:
                self._past.update(asdict(client.counters))
                self._client = None
                self.connected = False
                await client.aclose()

    async def _pause(self, seconds: float) -> None:
        await self._clock.sleep_until_ns(self._clock.monotonic_ns() + int(seconds * NS_PER_S))

    def _lost(self, error: FieldtwinError) -> None:
        self.connected, self.error = False, str(error)
        for device in self.devices:
            self._offline(device, error)
        self._jobs.fail_all(error)

    async def _serve(self, client: ModbusClient, backoff: Backoff) -> None:
        unanswered = Unanswered(client)
        stream = self.config.endpoint.scheme in STREAMS
        while True:
            self._wakeup.reset()
            if client.units.late_ns:
                self._patience.heard_late(self.devices, client.units, self._clock.monotonic_ns())
            if stream and unanswered.too_many(any(device.online for device in self.devices)):
                raise ConnectionLost(
                    f"{MOST_UNANSWERED} consecutive requests were not answered: the gateway reconnects",
                    where=str(self.config.endpoint),
                )
            if self._coming is not None:
                self._take_over()
            if self._halted:
                self._idle.set()
                await self._wakeup.sleep(None)
                continue
            now_ns = self._clock.monotonic_ns()
            wake_ns = now_ns + NS_PER_S
            if self._jobs:
                job, wake_ns = self._jobs.next(client.units, now_ns)
                if job is not None:
                    await self._run_job(job)
                    continue
            device, group, at_ns = self._turns.next(client.units.spaced_ns, now_ns, self.latency, self.config.timeout_s)
            due = at_ns <= now_ns
            if (
                self.guests.size
                and not (due and self._bridge_request_was_last)
                and await self._carry_out_bridge_request()
            ):
                backoff.reset()
            elif due and device is not None:
                self._bridge_request_was_last = False
                await self._poll(client, device, group)
                backoff.reset()
            else:
                await self._wakeup.sleep(min(at_ns, wake_ns))

    async def _carry_out_bridge_request(self) -> bool:
        """Carry out one waiting request of a bridge client. Return False if there was none."""
        client = self._client
        guest = self.guests.take(self._clock.monotonic_ns()) if client is not None else None
        if guest is None or client is None:
            return False
        self._bridge_request_was_last = True
        await self.guests.carry_out(guest, client, framing_of(self.config.endpoint) == "rtu")
        return True

    async def _poll(self, client: ModbusClient, device: DeviceState, group: str) -> None:
        """Use the bus once for a device: for one transaction of a group, or for the first contact."""
        begun_ns = self._clock.monotonic_ns()
        device.polls += not device.online or device.reading is None
        unit, probed = device.driver.config.address, not device.online
        try:
            if probed:
                device.tried, device.asked_ns = True, begun_ns
                if device.timeout_ns:
                    client.units.shorten_timeout(unit, device.timeout_ns / NS_PER_S)
                group = await self._requests.bring_online(device)
            elif not device.alone:
                client.units.shorten_timeout(unit, self._patience.timeout_s(device, begun_ns))
            await self._requests.turn(device, group)
        except ConnectionLost:
            raise
        except ReplyTimeout as e:
            self._handle_no_answer(client, device, e, begun_ns, probed)
        except (WireError, WrongDevice, Unreachable, GatewayRefusal) as e:
            self._failed(client, device, e, begun_ns, probed)
        except DeviceRefused as e:
            self._refused(device, group, e)
        else:
            device.online, device.error = True, ""
            device.last_cost_ns = device.silences = 0
            device.answered_ns = self._clock.monotonic_ns()
            device.backoff.reset()
        finally:
            if client.units.is_shortened(unit):
                client.units.restore_timeout(unit)

    def _handle_no_answer(
        self, client: ModbusClient, device: DeviceState, error: ReplyTimeout, begun_ns: int, probed: bool
    ) -> None:
        """Handle a device that did not answer. If it answered before, its request is repeated while repetitions are left.

        The other devices are polled meanwhile.
        """
        if not probed and not device.alone:
            shortened = self._patience.fell_silent(device, begun_ns, self._clock.monotonic_ns())
            # A missing reply after a shortened timeout proves nothing. A slow device is tried again, with more time once its
            # late reply was received.
            tries = max(self._requests.retries_of(device), 1 if shortened else 0)
            if device.reading is not None and device.silences < tries:
                device.silences += 1
                device.poll_errors += 1
                return
        self._failed(client, device, error, begun_ns, probed)

    def _failed(
        self, client: ModbusClient, device: DeviceState, error: FieldtwinError, begun_ns: int, probed: bool
    ) -> None:
        """Record that a device is away, and charge the duration of the attempt to the budget of probes."""
        device.poll_errors += 1
        self._offline(device, error)
        now_ns = self._clock.monotonic_ns()
        clear_ns = max(now_ns, client.clear_ns)
        answered_first = probed and not client.units.is_shortened(device.driver.config.address)
        device.fits = device.fits and probed and not answered_first
        device.last_cost_ns = clear_ns - begun_ns if answered_first else 0
        self._turns.failed(device, begun_ns, now_ns, clear_ns)

    def _refused(self, device: DeviceState, group: str, error: DeviceRefused) -> None:
        """Handle a device that answers but refuses this group. Its other groups are still read.

        The exceptions busy (06) and acknowledge (05: the request takes long) mean that the request may succeed later. The last
        value stays valid until it is stale, it is never replaced by 0, and the device gets a pause (MB-023, MB-024). The pause
        is one for the whole device: other groups that get one of these exceptions before the pause is over wait until its end.
        Only an exception after its end makes the next pause longer.
        """
        device.poll_errors += 1
        device.reading = None
        if not group:  # the device refused the request for its identity
            self._offline(device, error)
            return
        device.online, device.error = True, str(error)
        if isinstance(error, Acknowledged | ServerBusy):
            now_ns = self._clock.monotonic_ns()
            if now_ns >= device.busy_until_ns:
                device.busy_until_ns = now_ns + int(device.backoff.next_s() * NS_PER_S)
            device.schedule.defer(group, device.busy_until_ns)
            return
        names = [f"{device.driver.config.name}.{t.name}" for t in device.driver.profile.group(group)]
        self._tags.put_bad(names, reason_of(error))

    def _offline(self, device: DeviceState, error: FieldtwinError) -> None:
        was_online = device.online
        device.online, device.error = False, str(error)
        device.reading = None
        device.silences = 0
        device.schedule.stop()
        device.next_try_ns = self._clock.monotonic_ns() + int(device.backoff.next_s() * NS_PER_S)
        self._tags.put_bad(device.driver.tag_names, reason_of(error))
        if was_online:
            self._on_offline(device.driver)

    async def _run_job(self, job: BusJob) -> None:
        device = next((d for d in self.devices if d.driver is job.driver), None)
        if device is not None and device.tried and not device.online:
            job.done(Unreachable(f"the device is lost: {device.error}", where=job.driver.config.where))
            return
        try:
            await self._requests.attempts(device, job.run)
        except ConnectionLost as e:
            job.done(e)
            raise
        except FieldtwinError as e:
            job.done(e)
        else:
            job.done(None)
