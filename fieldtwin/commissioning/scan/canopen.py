"""`scan` of a CANopen bus: listen, then read 1000h from each node, then LSS fastscan for nodes without an ID.

The rate of the reads is limited. Nothing is sent before the bus has been observed. Nothing is sent at all if traffic was
received and the user did not allow sharing the bus. No SDO is sent to a node that exchanges SDOs with another master: two
clients on one SDO channel disturb each other's transfers.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import dataclass, field, replace

from fieldtwin.commissioning.access.connection import canopen_at, frames_at
from fieldtwin.commissioning.access.progress import PhaseProgress
from fieldtwin.commissioning.scan.can_listener import BusListener, ObservedBus
from fieldtwin.gateway.connections.can.facts import CanFacts, can_facts
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.clock import NS_PER_S, Clock
from fieldtwin.gateway.core.connection import Connector, Direction, Tap
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import DeviceRefused, UsageError, WireError
from fieldtwin.gateway.protocols.canopen import cob_id
from fieldtwin.gateway.protocols.canopen.lss.frames import LssAddress
from fieldtwin.gateway.protocols.canopen.lss.master import LssMaster
from fieldtwin.gateway.protocols.canopen.master import CanopenMaster
from fieldtwin.gateway.protocols.canopen.scan import FoundNode, scan_nodes
from fieldtwin.gateway.wallclock import WallClock

ALL_NODES = tuple(range(1, cob_id.NODE_MAX + 1))
ADAPTER_RATES = (125_000, 250_000, 500_000, 1_000_000, 50_000, 20_000, 100_000, 800_000, 10_000)
"""The bit rates (bit/s) of CiA 301, 5.3, likely ones first."""
RATE_LISTEN_S = 1.0
QUIET_S = 0.5
"""Time in seconds without an SDO request of another master, after which the scan sends one."""
PATIENCE_S = 5.0
FASTSCAN_S = 13.5
MOST_UNCONFIGURED = 16


@dataclass(frozen=True, slots=True)
class CanScanOptions:
    """The options of a scan. `per_s`: maximum number of SDO reads per second. `lss`: look for nodes without a node ID."""

    bitrate: int = 0
    nodes: tuple[int, ...] = ALL_NODES
    listen_s: float = 5.0
    timeout_s: float = 0.1
    per_s: float = 10.0
    lss: bool = True
    listen_only: bool = False
    share_bus: bool = False


@dataclass(slots=True)
class CanScan:
    """The findings of a CANopen scan so far. `blocked`: nodes that exchange SDOs with another master, not queried by the scan."""

    url: str
    bitrate: int = 0
    facts: CanFacts | None = None
    heard: ObservedBus = field(default_factory=ObservedBus)
    listened_s: float = 0.0
    nodes: list[FoundNode] = field(default_factory=list)
    blocked: list[int] = field(default_factory=list)
    unconfigured: list[LssAddress] = field(default_factory=list)
    asked: int = 0
    took_s: float = 0.0
    stopped: bool = False
    conflicts: dict[int, str] = field(default_factory=dict)
    """For each node ID that two nodes seem to have: the reason to assume so."""
    notes: list[str] = field(default_factory=list)

    @property
    def sent(self) -> bool:
        return self.asked > 0


class _ListenerTap(Tap):
    """An observer that passes received frames to the listener, also while the scan sends."""

    def __init__(self, listener: BusListener) -> None:
        self._listener = listener

    def on_bytes(self, endpoint: Endpoint, direction: Direction, t_ns: int, data: bytes) -> None:
        pass

    def on_frame(self, endpoint: Endpoint, direction: Direction, t_ns: int, frame: CanFrame) -> None:
        if direction is Direction.RECEIVED:
            self._listener.feed(frame, t_ns)


class CanScanner:
    """One scan of `url`; `run` it once. `stop` is called often: when it returns True, `run` ends and the findings are kept."""

    def __init__(
        self,
        url: str,
        options: CanScanOptions | None = None,
        *,
        on_progress: Callable[[PhaseProgress], None] = lambda _: None,
        stop: Callable[[], bool] = lambda: False,
        taps: Sequence[Tap] = (),
        connector: Connector | None = None,
        clock: Clock | None = None,
        facts: Callable[[Endpoint], CanFacts] = can_facts,
    ) -> None:
        self._endpoint = Endpoint.parse(url)
        if not self._endpoint.is_can:
            raise UsageError("CANopen needs a CAN bus", expected="can:INTERFACE/CHANNEL", got=url)
        self._options = options or CanScanOptions()
        self._tell, self._stop = on_progress, stop
        self._connector, self._clock = connector, clock or WallClock()
        self._facts = facts
        self._listener = BusListener()
        self._taps = (_ListenerTap(self._listener), *taps)
        self.result = CanScan(url, heard=self._listener.heard)

    async def run(self) -> CanScan:
        """Run the scan. Raises `Unreachable` if the bus cannot be opened, `UsageError` if its bit rate differs from the
        requested one.
        """
        began_ns = self._clock.monotonic_ns()
        try:
            self.result.facts = self._facts(self._endpoint)
            await self._listen()
            self.result.heard = deepcopy(self._listener.heard)  # later frames include answers to the scan
            if self._may_ask():
                await self._ask()
        finally:
            if (second := self._listener.heard.sync_producers) not in ("", *self.result.notes):
                self.result.notes.append(second)
            self.result.took_s = (self._clock.monotonic_ns() - began_ns) / NS_PER_S
            self.result.stopped = self._stop()
        return self.result

    # -- listening ------------------------------------------------------------------------------------------------

    async def _listen(self) -> None:
        result, options = self.result, self._options
        facts = result.facts
        assert facts is not None
        result.bitrate = options.bitrate or facts.bitrate
        if result.bitrate or not facts.needs_bitrate:
            await self._hear(self._silent_endpoint(), options.bitrate, options.listen_s)
        elif facts.can_listen_only:
            await self._try_rates()
        else:
            raise UsageError(
                f"{self._endpoint}: this adapter has no listen-only mode, and the bit rate is unknown",
                expected="--bitrate",
            )
        if options.bitrate and facts.bitrate and facts.bitrate != options.bitrate:
            result.notes.append(f"the interface runs at {facts.bitrate} bit/s, not at {options.bitrate}")

    async def _try_rates(self) -> None:
        """Listen at one bit rate after another, for an adapter whose bit rate is not set.

        At a wrong bit rate no valid frame is received, so received frames prove the rate.
        """
        result = self.result
        for rate in ADAPTER_RATES:
            if self._stop():
                return
            before = self._listener.heard.frames
            await self._hear(self._silent_endpoint(), rate, RATE_LISTEN_S, f"listening at {rate} bit/s")
            if self._listener.heard.frames > before:
                result.bitrate = rate
                result.notes.append(f"frames are whole at {rate} bit/s")
                await self._hear(self._silent_endpoint(), rate, self._options.listen_s)
                return
        result.notes.append(
            "no frame at any bit rate: no node sends, or the cable is not connected; use --bitrate to send requests"
        )

    async def _hear(self, endpoint: Endpoint, bitrate: int, listen_s: float, phase: str = "listening") -> None:
        result, clock = self.result, self._clock
        async with frames_at(
            str(endpoint), bitrate, taps=self._taps, connector=self._connector, clock=clock
        ) as connection:
            known = getattr(connection, "bitrate", 0)
            result.bitrate = result.bitrate or (known if isinstance(known, int) else 0)
            began_ns = clock.monotonic_ns()
            while not self._stop() and (elapsed_s := (clock.monotonic_ns() - began_ns) / NS_PER_S) < listen_s:
                heard = self._listener.heard
                self._tell(PhaseProgress(phase, elapsed_s, listen_s, f"{heard.frames} frames", len(heard.nodes)))
                await clock.sleep_until_ns(clock.monotonic_ns() + round(min(0.1, listen_s - elapsed_s) * NS_PER_S))
                connection.inbound.data_stream.clear()  # already counted when it arrived
            result.listened_s += (clock.monotonic_ns() - began_ns) / NS_PER_S

    def _silent_endpoint(self) -> Endpoint:
        """Return the endpoint for listening: in listen-only mode, without acknowledging frames, if the adapter has that mode."""
        facts = self.result.facts
        if facts is None or not facts.can_listen_only or self._endpoint.param("listen"):
            return self._endpoint
        return replace(self._endpoint, params=(*self._endpoint.params, ("listen", "1")))

    # -- asking ---------------------------------------------------------------------------------------------------

    def _may_ask(self) -> bool:
        heard, result, facts = self._listener.heard, self.result, self.result.facts
        assert facts is not None
        if self._options.listen_only or self._stop():
            return False
        if facts.listen_only:
            result.notes.append("the interface is in listen-only mode: nothing can be sent")
            return False
        if facts.needs_bitrate and not result.bitrate:
            return False
        if heard.errors and not heard.frames:
            result.notes.append("error frames and no valid frame: the bit rate is wrong, or the bus is not terminated")
            return False
        if heard.frames and not self._options.share_bus:
            result.notes.append(
                "this bus carries traffic, so nothing was sent; --share-bus asks the nodes one at a time"
            )
            return False
        return True

    async def _ask(self) -> None:
        options = self._options
        async with canopen_at(
            str(self._endpoint),
            self.result.bitrate if self.result.facts and self.result.facts.needs_bitrate else options.bitrate,
            sdo_timeout_s=options.timeout_s,
            taps=self._taps,
            connector=self._connector,
            clock=self._clock,
        ) as master:
            each_s = max(options.timeout_s + 0.01, 1 / options.per_s)
            lss_s = FASTSCAN_S if options.lss else 0.0
            total_s = len(options.nodes) * each_s + lss_s
            self.result.conflicts = master.conflicts
            for i, node in enumerate(options.nodes):
                if self._stop() or self._met_master():
                    return
                self._tell(PhaseProgress("asking nodes", i * each_s, total_s, f"node {node}", len(self.result.nodes)))
                await self._ask_node(master, node, each_s)
            if options.lss and not self._met_master():
                await self._look_for_unconfigured(master, len(options.nodes) * each_s, total_s)

    def _met_master(self) -> bool:
        """Return whether another master, from which nothing was received before, has begun to send and the bus may not be
        shared.
        """
        if self._options.share_bus or not self._listener.heard.has_master:
            return False
        note = "another master started to send, so the scan stopped; --share-bus continues, one node at a time"
        if note not in self.result.notes:
            self.result.notes.append(note)
        return True

    async def _ask_node(self, master: CanopenMaster, node: int, each_s: float) -> None:
        clock, result = self._clock, self.result
        began_ns = clock.monotonic_ns()
        if not await self._sdo_is_free(node):
            result.blocked.append(node)
            return
        result.asked += 1
        result.nodes += await scan_nodes(
            master, clock, nodes=(node,), listen_s=0.0, pause_s=0.0, timeout_s=self._options.timeout_s
        )
        await clock.sleep_until_ns(began_ns + round(each_s * NS_PER_S))

    async def _sdo_is_free(self, node: int) -> bool:
        """Wait until no other master has sent an SDO request for `QUIET_S`. Return False if another master exchanges SDOs
        with this node, or if the others do not stop in time.
        """
        clock, masters = self._clock, self._listener.heard.sdo_masters
        deadline_ns = clock.monotonic_ns() + round(PATIENCE_S * NS_PER_S)
        while masters:
            if node in masters:
                return False
            free_ns = max(masters.values()) + round(QUIET_S * NS_PER_S)
            now_ns = clock.monotonic_ns()
            if free_ns <= now_ns:
                return True
            if now_ns >= deadline_ns or self._stop():
                return False
            await clock.sleep_until_ns(min(free_ns, deadline_ns))
        return True

    async def _look_for_unconfigured(self, master: CanopenMaster, done_s: float, total_s: float) -> None:
        result = self.result
        if self._listener.heard.lss_requests:
            result.notes.append("another LSS master is active, so there is no fastscan")
            return
        with _lss(master, self._clock) as lss:
            result.asked += 1
            if not await lss.any_unconfigured():
                return
            self._tell(PhaseProgress("LSS fastscan", done_s, total_s, "", len(result.nodes)))
            try:
                while not self._stop() and len(result.unconfigured) < MOST_UNCONFIGURED:
                    found = await lss.fastscan(
                        verify=not result.unconfigured
                    )  # LSS: a node that was found does not answer further fastscan requests
                    if found is None:
                        break
                    result.unconfigured.append(found)
                    self._tell(PhaseProgress("LSS fastscan", done_s, total_s, str(found), len(result.nodes)))
            except (WireError, DeviceRefused) as e:
                result.notes.append(f"LSS fastscan ended early: {e}")
            finally:
                await lss.switch_all(configuration=False)


@contextmanager
def _lss(master: CanopenMaster, clock: Clock) -> Iterator[LssMaster]:
    lss = LssMaster(master.send, clock)
    master.listen(cob_id.LSS_REPLY, lss.on_reply)
    yield lss
