"""The checks of one system in virtual time, alone or in a group, and its summary.

Every value published as good is compared with the values that its device held; the states of the programs, the commands
that arrived, and the invariants of the system file are checked too.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

from msgspec.structs import replace

from fieldtwin.emulators.faults.schema import seconds
from fieldtwin.gateway.core.clock import NS_PER_MS, NS_PER_S
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.statemachine import encode_period
from fieldtwin.gateway.core.values import Quality, TagValue
from fieldtwin.gateway.runtime.buses.modbus.learnt_gaps import learnt_statuses
from fieldtwin.gateway.runtime.gateway import stale_limits
from fieldtwin.gateway.runtime.gateway_status import GatewayStatus, OutputStatus
from fieldtwin.gateway.runtime.status import describe
from fieldtwin.plc.status import PlcStatus
from fieldtwin.results.trace import TraceEvent, TraceKind
from fieldtwin.run.benches.invariant_watch import InvariantWatch
from fieldtwin.run.benches.virtual_bench import VirtualBench
from fieldtwin.run.live.summary import RunFacts, summarise
from fieldtwin.run.processes.states import StateWatch, expected_states
from fieldtwin.run.processes.topside import TopsideController
from fieldtwin.run.virtual.age_oracle import AgeOracle
from fieldtwin.run.virtual.message_oracle import MessageOracle
from fieldtwin.scenarios.judging.runner import TICK_S
from fieldtwin.twin.prototype.field import FieldSimulator
from fieldtwin.twin.prototype.field_status import FieldStatus
from fieldtwin.twin.site.system import System

SETTLE_S = 10.0
"""Longest time in seconds to wait, after the end of the run, until the programs have followed a command in progress."""
LAST_REPLIES_S = 0.5
CALM_S = 60.0
"""Time in seconds after the last fault in which the system must recover."""
CAN_WIRE_NS = 10 * NS_PER_MS
"""The time in ns that a frame may need on a CAN bus, including repeated attempts and waiting for other frames."""
STALE_CHECK_NS = 100 * NS_PER_MS
"""Minimum time between two checks for values that are still good although they exceed their maximum age."""
_GOOD = Quality.GOOD  # module constants, because looking up members of an Enum is slow


class SystemCheck:
    """The checks of one system. Call `attach`, then `check` from time to time, then `finish`, and then `summary`.

    `faults` are those that are injected into this system. `disturbed`: whether the counts of gateway and emulators may differ;
    by default if there are faults. `may_refuse`: tags of which a scenario expects that their outputs are refused.
    """

    def __init__(
        self,
        system: System,
        faults: Sequence[dict[str, Any]] = (),
        *,
        disturbed: bool | None = None,
        may_refuse: tuple[str, ...] = (),
    ) -> None:
        self.system = system
        self.faults = faults
        self.disturbed = bool(faults) if disturbed is None else disturbed
        self.may_refuse = may_refuse
        self.elapsed_s = 0.0
        self.states = StateWatch(system)
        self.oracle = AgeOracle()
        self.messages = MessageOracle()
        """Compares the commands that reached the gateway through a mailbox with those that the remote client sent."""
        self.invariants: InvariantWatch | None = None
        """The invariants that this run checks; a scenario checks the invariants itself."""
        self.gateway_status: GatewayStatus | None = None
        self.plc_status: PlcStatus | None = None
        self.field_status: FieldStatus | None = None
        self.outputs_confirmed_safe: bool | None = None
        self.mapping: dict[Endpoint, Endpoint] = {}
        self.far: dict[str, Endpoint] = {}
        self.topside: TopsideController | None = None
        self._stated = InvariantWatch(system)
        self._numbers: dict[str, int] = {}
        self._emulated: frozenset[str] = frozenset()

    @property
    def calm(self) -> bool:
        """Return whether every fault had been over for `CALM_S` at the end."""
        ends = (fault.get("until") for fault in self.faults)
        return all(end is not None and seconds(end) <= self.elapsed_s - CALM_S for end in ends)

    def watch_invariants(self, bench: VirtualBench, nursery: Nursery) -> None:
        """Check the invariants of the system file from now on, in a task of `nursery`."""
        self.invariants = self._stated
        if self._stated:
            nursery.start(self._stated.run(bench, TICK_S), "invariants")

    def attach(self, bench: VirtualBench) -> None:
        """Begin to check the events on `bench`."""
        self.mapping, self.far, self.topside = bench.run.mapping, bench.run.field.far, bench.topside
        self._emulated = frozenset(bench.run.field.devices)
        bench.run.gateway.tags.subscribe(self._watched(bench))
        if self.topside is not None:
            for pump in bench.run.gateway.pumps:
                if pump.driver.config.name in self.far:
                    self.messages.watch(pump.driver.emitter)
        bench.trace.listen(self._on_state, TraceKind.STATE)
        self.states.knows(bench.run.twin.ecs.layout)
        for program, state in bench.states().items():
            self.states.note(program, state, bench.loop.now_ns)

    def check(self, bench: VirtualBench) -> None:
        """Check the values published since the last call. Call it often enough that no journal overflows."""
        self.elapsed_s = bench.now_s()
        self._judge(bench.run.field)

    async def finish(self, bench: VirtualBench) -> None:
        """Stop the gateway in an orderly way and read the final counters. Call `summary` afterwards."""
        self.outputs_confirmed_safe = await bench.run.stop_gateway()
        outputs = describe(bench.run.gateway, bench.loop.now_ns).outputs  # a stopped node has no certain values
        await bench.sleep_until_s(bench.now_s() + LAST_REPLIES_S)
        self._judge(bench.run.field)
        if self.topside is not None:
            self.messages.check([encode_period(period).data for period in self.topside.commands_sent])
        self._take_status(bench, outputs)

    async def settle(self, bench: VirtualBench) -> None:
        """Wait until the programs have followed all commands, at most `SETTLE_S`."""
        deadline_s = bench.now_s() + SETTLE_S
        while self.topside is not None and bench.now_s() < deadline_s:
            expected = expected_states(self.topside.commands_sent)
            if all(self.states.sequence(p) == expected for p in self.states.relays):
                return
            await bench.sleep_until_s(bench.now_s() + 0.1)

    def _watched(self, bench: VirtualBench) -> Callable[[str, TagValue], None]:
        loop = bench.loop
        asked_by_device = {
            name: bench.asked_ns[device.bus]
            for name, device in self.system.devices.items()
            if not self.system.buses[device.bus].endpoint.is_can
        }
        check_ages, published, next_check_ns = self._age_check(bench), self.oracle.published, 0
        asked_of: dict[str, deque[int] | None] = {}
        """The times of requests on the bus of each tag; None for a message that a node sends by itself."""

        def put(name: str, value: TagValue) -> None:
            nonlocal next_check_ns
            now_ns = loop.now_ns
            if now_ns >= next_check_ns:
                next_check_ns = now_ns + STALE_CHECK_NS
                check_ages()
            if value.quality is _GOOD:
                # A value is timed at the moment when its reply was complete; the device answered after the request. A
                # node's unrequested message was on the bus for some time, longer if it had to be sent again.
                try:
                    asked = asked_of[name]
                except KeyError:
                    asked = asked_of[name] = asked_by_device.get(name.partition(".")[0])
                since_ns = value.t_ns
                if asked is None:
                    since_ns -= CAN_WIRE_NS
                else:
                    for asked_ns in reversed(asked):
                        if asked_ns <= since_ns:
                            since_ns = asked_ns
                            break
                published(name, value.raw, value.value, since_ns, now_ns)

        return put

    def _age_check(self, bench: VirtualBench) -> Callable[[], None]:
        """Return a function that reports to `AgeOracle` which values the gateway still considers good, including those that
        were not published again.

        The device must have held such a value within the value's maximum age, plus the time of one exchange. The
        caller calls the function at most every `STALE_CHECK_NS`.
        """
        tags, loop, still_good = bench.run.gateway.tags, bench.loop, self.oracle.still_good
        aging = [
            (tag, held, limit_ms * NS_PER_MS + self._exchange_ns(driver.config.bus))
            for driver in bench.run.gateway.drivers.values()
            for tag, limit_ms in stale_limits(driver).items()
            if limit_ms is not None and (held := tags.entry(tag)) is not None
        ]

        def check() -> None:
            now_ns = loop.now_ns
            for tag, held, limit_ns in aging:
                value = held.as_of(now_ns)
                if value.quality is _GOOD:
                    still_good(tag, value.raw, value.value, now_ns - limit_ns, now_ns)

        return check

    def _exchange_ns(self, bus: str) -> int:
        """Return in ns how much older than its last refresh a value may be, because the device held it before its reply came."""
        config = self.system.buses[bus]
        return CAN_WIRE_NS if config.endpoint.is_can else round(config.timeout_s * NS_PER_S)

    def _on_state(self, event: TraceEvent) -> None:
        if event.where.endswith(".state") and isinstance(event.data["value"], str):
            self.states.note(event.where.removesuffix(".state"), event.data["value"], event.t_ns)

    def _judge(self, side: FieldSimulator) -> None:
        for name, device in side.devices.items():
            for held in device.journal.since(self._numbers.get(name, 0)):
                self.oracle.held(f"{name}.{held.tag}", held.raw, held.t_ns)
                self._numbers[name] = held.number
        self.oracle.check(self._emulated)

    def _take_status(self, bench: VirtualBench, outputs: list[OutputStatus]) -> None:
        now_ns = bench.loop.now_ns
        gateway, plc = bench.run.gateway, bench.run.plc
        learnt = learnt_statuses(gateway.drivers.values())
        self.gateway_status = replace(describe(gateway, now_ns), outputs=outputs, learnt=learnt)
        self.plc_status = plc.status()
        self.field_status = bench.run.field.status()

    def summary(self, errors: Sequence[str] = ()) -> dict[str, Any]:
        """Return the summary of the system, in the form of a run in real time; `errors` are those of the run."""
        invariants, topside = self.invariants, self.topside
        facts = RunFacts(
            prototype=True,
            system=self.system,
            instance="virtual",
            elapsed_s=self.elapsed_s,
            disturbed=self.disturbed,
            calm=self.calm,
            errors=tuple(errors),
            gateway=self.gateway_status,
            plc=self.plc_status,
            field=self.field_status,
            counted_before={},
            clients_before={},
            mapping=self.mapping,
            published=self.oracle.describe(),
            wrong_messages=tuple(self.messages.wrong),
            invariants=invariants.results() if invariants is not None else (),
            invariant_errors=invariants.errors() if invariants is not None else (),
            states=self.states.seen(),
            topside=topside.describe() if topside is not None else None,
            commands_sent=tuple(topside.commands_sent) if topside is not None else (),
            outputs_confirmed_safe=self.outputs_confirmed_safe,
            may_refuse=self.may_refuse,
        )
        return summarise(facts)
