"""The CAN bus model on an event loop: it advances time, delivers frames to ports and holds senders back.

It uses the loop's clock (wall or virtual time) and no sockets: the TCP server is one kind of port, and a connection inside the
same process is a different kind.
"""

from __future__ import annotations

import asyncio
import heapq
from collections import deque
from collections.abc import Collection, Iterator
from typing import Any, NamedTuple, Protocol

from fieldtwin.emulators.endpoints.can.overrun import ReportsOverrun
from fieldtwin.emulators.wires.can_bus import CanBus
from fieldtwin.emulators.wires.can_faults import ErrorRule
from fieldtwin.gateway.core.can_error import CanErrorState, state_frame, violation_frame
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.connection import CANConnection, closed_locally
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import ConnectionLost, FieldtwinError


class BusPort(Protocol):
    """A participant of the bus. The event loop calls its methods, which may not wait."""

    def on_frame(self, frame: CanFrame) -> bool:
        """Receive a frame of a different node that ended at `frame.t_ns`.

        Return False if there is no room; the frame is then lost and counted.
        """
        ...

    def on_confirmed(self, frame: CanFrame) -> None:
        """Note that a frame of this node was sent on the bus; its place in the transmit queue is free."""
        ...

    def on_error(self, frame: CanFrame, *, violation: bool) -> None:
        """Receive an error frame of this node's controller (gateway/core/can_error.py).

        The controller's state has changed, or (`violation`) it took part in an attempt that ended in an error.
        """
        ...

    def on_settled(self) -> None:
        """Note that all frames that ended at this time have been delivered."""
        ...

    def on_bus_closed(self, error: FieldtwinError) -> None:
        """Note that the bus has closed."""
        ...


class _ReportedError(NamedTuple):
    """An error frame that a controller passes to its node, with the number of the node."""

    t_ns: int
    order: int
    node: int
    frame: CanFrame
    violation: bool


class BusRunner:
    """The runner of a `CanBus` on the running loop. If `paced`, frames have their real duration; otherwise none.

    A late wake-up of this process delays deliveries, but does not change the times on the bus: frames keep their exact
    `frame.t_ns`.
    """

    def __init__(
        self,
        bitrate: int,
        *,
        paced: bool = True,
        queue_frames: int = 64,
        max_nodes: int = 128,
        monitored: bool = True,
        data_bitrate: int = 0,
    ) -> None:
        self._loop = asyncio.get_running_loop()
        self._time = self._loop.time
        self._bus = CanBus(
            bitrate,
            instant=not paced,
            queue_frames=queue_frames,
            max_nodes=max_nodes,
            monitored=monitored,
            data_bitrate=data_bitrate,
        )
        self._ports: dict[int, BusPort] = {}
        self._timer: asyncio.TimerHandle | asyncio.Handle | None = None
        self._due_ns = 0
        self._pumping = False
        self._closed: FieldtwinError | None = None

    @property
    def bitrate(self) -> int:
        return self._bus.bitrate

    @property
    def data_bitrate(self) -> int:
        """Return the bit rate of the data phase of CAN FD frames with the bit-rate switch, in bit/s."""
        return self._bus.data_bitrate

    @property
    def queue_frames(self) -> int:
        return self._bus.queue_frames

    def now_ns(self) -> int:
        """Return the loop's clock in ns."""
        return int(self._time() * NS_PER_S)

    def join(self, port: BusPort, name: str = "", *, listen_only: bool = False) -> int:
        """Add a port and return its node number.

        Raises `EndpointBusy` if the bus is full, or the reason why the bus closed.
        """
        if self._closed is not None:
            raise self._closed
        node = self._bus.join(self.now_ns(), name, listen_only=listen_only)
        self._ports[node] = port
        self._schedule()  # the node acknowledges frames from now on
        return node

    def leave(self, node: int) -> None:
        """Remove a port, which receives nothing more; its queued frames are still sent."""
        if self._ports.pop(node, None) is not None:
            self._bus.leave(node, self.now_ns())
            self._schedule()

    def submit(self, node: int, frame: CanFrame, *, more: bool = False, counted: bool = True) -> bool:
        """Queue a frame. Return False if the node's transmit queue is full: try again after `on_confirmed`.

        `CanBus.submit` describes `counted`. With `more` the caller has further frames, and calls `settle` after the last one.
        """
        now_ns = self.now_ns()
        taken = self._bus.submit(node, frame, now_ns, counted=counted)
        if not more:
            self._schedule(now_ns)
        return taken

    def withdraw(self, node: int, can_ids: Collection[int]) -> list[CanFrame]:
        """Withdraw frames of the node with `can_ids` that are queued and not sent yet, and return them."""
        taken = self._bus.withdraw(node, can_ids, self.now_ns())
        self._schedule()
        return taken

    def settle(self) -> None:
        """End a series of calls of `submit` with `more`. If frames take no time, they are sent now."""
        if self._bus.instant and not self._pumping and self._timer is None and self._closed is None:
            self._due_ns = self.now_ns()
            self._pump()
        else:
            self._schedule()

    def disturb(self, rule: ErrorRule) -> None:
        """Destroy attempts to send as `rule` says (`can_faults.spoil` creates one)."""
        self._bus.disturb(rule)

    def undisturb(self, rule: ErrorRule) -> None:
        """Remove a rule."""
        self._bus.undisturb(rule)

    def attach(self, endpoint: Endpoint, name: str = "", max_pending: int = 4096) -> AttachedConnection:
        """Return a connection for a node of this process, on the same bus."""
        return AttachedConnection(self, endpoint, name, max_pending)

    def stats(self) -> dict[str, Any]:
        """Return the present `CanBus.stats`."""
        return self._bus.stats(self.now_ns())

    def close(self, error: FieldtwinError) -> None:
        """Stop the bus and notify every port; queued frames are lost."""
        self._closed = error
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        ports, self._ports = self._ports, {}
        for port in ports.values():
            port.on_bus_closed(error)

    def _schedule(self, now_ns: int | None = None) -> None:
        news = self._bus.has_news
        due_ns = None if news else self._bus.next_event_ns()
        if (due_ns is None and not news) or self._closed is not None:
            return
        if now_ns is None:
            now_ns = self.now_ns()
        if due_ns is None:
            due_ns = now_ns
        if self._timer is not None:
            if self._due_ns <= due_ns:
                return  # the pending timer fires early enough
            self._timer.cancel()
        self._due_ns = due_ns
        if due_ns <= now_ns:
            # Not immediately: all nodes that submit in this iteration of the loop take part in the arbitration.
            self._timer = self._loop.call_soon(self._pump)
        else:
            self._timer = self._loop.call_at(due_ns / NS_PER_S, self._pump)

    def _pump(self) -> None:
        self._timer = None
        self._pumping = True
        try:
            self._hand_out()
        finally:
            self._pumping = False
        self._schedule()

    def _hand_out(self) -> None:
        # The loop may fire a timer one clock resolution early; the end of the frame still counts as reached.
        deliveries = self._bus.advance(max(self.now_ns(), self._due_ns))
        frames = self._error_frames() if self._bus.has_news else None
        touched: dict[int, BusPort] = {}
        for delivery in deliveries:
            while frames and frames[0].t_ns < delivery.frame.t_ns:
                self._tell(frames.popleft(), touched)
            for node in delivery.receivers:
                if (port := self._ports.get(node)) is not None:
                    touched[node] = port
                    if not port.on_frame(delivery.frame):
                        self._bus.count_overrun(node)
            for node in delivery.senders:
                if (port := self._ports.get(node)) is not None:
                    touched[node] = port
                    port.on_confirmed(delivery.frame)
        while frames:
            self._tell(frames.popleft(), touched)
        for port in touched.values():
            port.on_settled()

    def _error_frames(self) -> deque[_ReportedError]:
        """Return the new error frames of all controllers, in order of time."""
        states = (
            _ReportedError(
                n.t_ns, 1, n.node, state_frame(n.state, n.tec, n.rec, restarted=restarted, t_ns=n.t_ns), violation=False
            )
            for n in self._bus.take_notices()
            for restarted in (n.before is CanErrorState.BUS_OFF,)
        )
        return deque(heapq.merge(self._violations(), states, key=lambda error: (error.t_ns, error.order)))

    def _violations(self) -> Iterator[_ReportedError]:
        for fault in self._bus.take_faults():
            for node, tec, rec in fault.counters:
                frame = violation_frame(fault.kind, tec, rec, fault.t_ns)
                yield _ReportedError(fault.t_ns, 0, node, frame, violation=True)

    def _tell(self, error: _ReportedError, touched: dict[int, BusPort]) -> None:
        if (port := self._ports.get(error.node)) is not None:
            touched[error.node] = port
            port.on_error(error.frame, violation=error.violation)


class AttachedConnection(ReportsOverrun):
    """The connection of a node in the same process. `recv` returns the other nodes' frames, stamped with their exact end of
    frame.

    Error frames report changes of its controller's state, and overruns.
    """

    def __init__(self, runner: BusRunner, endpoint: Endpoint, name: str, max_pending: int) -> None:
        super().__init__(CANConnection(), endpoint, max_pending)
        self._runner = runner
        self._turn = asyncio.Lock()  # keeps the order of concurrent senders
        self._held_back = 0
        self._room = asyncio.Event()
        self._node = runner.join(self, name)

    def send_at_once(self, frame: CanFrame) -> bool:
        """Queue `frame` if there is room and no sender waits for room.

        Otherwise return False; nothing is queued or counted.
        """
        if self._lost is not None:
            raise self._loss()
        return not self._held_back and self._runner.submit(self._node, frame, counted=False)

    async def send(self, frame: CanFrame) -> None:
        self._held_back += 1
        try:
            async with self._turn:
                while True:
                    if self._lost is not None:
                        raise self._loss()
                    if self._runner.submit(self._node, frame):
                        return
                    self._room.clear()
                    await self._room.wait()
        finally:
            self._held_back -= 1

    def withdraw(self, can_ids: Collection[int]) -> list[CanFrame]:
        """Withdraw queued frames with `can_ids` that are not sent yet, as a controller aborts its mailboxes."""
        if self.lost is not None:
            return []
        taken = self._runner.withdraw(self._node, can_ids)
        if taken:
            self._room.set()
        return taken

    async def aclose(self) -> None:
        self._runner.leave(self._node)
        self.feed_lost(closed_locally(self.endpoint))
        self.inbound.data_stream.clear()
        self._room.set()

    def on_frame(self, frame: CanFrame) -> bool:
        if frame.fd:
            return True  # a classic node of this process: like a kernel socket without the option for CAN FD
        before = self.overruns
        self.feed(frame)
        return self.overruns == before

    def on_confirmed(self, frame: CanFrame) -> None:
        if self._held_back:
            self._room.set()

    def on_error(self, frame: CanFrame, *, violation: bool) -> None:
        if not violation:
            self.feed(frame)

    def on_settled(self) -> None:
        """Do nothing: this port does not collect frames."""

    def on_bus_closed(self, error: FieldtwinError) -> None:
        self.feed_lost(ConnectionLost(error.message, where=str(self.endpoint)))
        self._room.set()
