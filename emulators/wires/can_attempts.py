"""One attempt to send on a modelled CAN bus: whether it ends as a frame or as an error, and its effect on all nodes.

This module holds the nodes with their transmit queues and error counters, and the time at which the bus is free again;
`can_bus` determines when an attempt is due and which nodes take part in its arbitration. This module does no I/O and reads no
clock; the only times are those of the attempts.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from functools import partial

from fieldtwin.emulators.wires import can_verdict
from fieldtwin.emulators.wires.can_events import CanErrorFrame, Delivery, Notice
from fieldtwin.emulators.wires.can_faults import SUSPEND_BITS, Disturbance, ErrorRule
from fieldtwin.emulators.wires.can_fd_timing import data_phase
from fieldtwin.emulators.wires.can_load import BusLoad
from fieldtwin.emulators.wires.can_nodes import BusOffNodes, Node, Start
from fieldtwin.emulators.wires.can_timing import INTERFRAME_BITS, bits_to_end
from fieldtwin.emulators.wires.can_verdict import FailedAttempt
from fieldtwin.gateway.core.can_error import CanErrorState
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.clock import NS_PER_S

_ACTIVE = CanErrorState.ACTIVE

MAX_NOTICES = 4096
"""The number of notices and errors that are kept until the caller takes them. The oldest are dropped."""


class Attempts:
    """The nodes of one bus, and the method `attempt`, which carries out one attempt. The results are collected in `done`,
    `notices` and `faults`, each in its order.

    `instant` and `monitored` are those of `CanBus`. `waiting` are the nodes on the bus that have something to send,
    `off` those in bus-off; `free_ns` is when the interframe space of the last attempt ends.
    """

    def __init__(self, bitrate: int, *, instant: bool, monitored: bool, data_bitrate: int = 0) -> None:
        self.bitrate = bitrate
        self.data_bitrate = data_bitrate or bitrate
        self.instant = instant
        self.monitored = monitored
        self.conflicts = 0
        self.error_frames = 0
        self.free_ns = 0
        self.load = BusLoad(bitrate)
        self.nodes: dict[int, Node] = {}
        self.waiting: dict[int, Node] = {}
        self.off = BusOffNodes()
        self.rules: list[ErrorRule] = []
        self.done: list[Delivery] = []
        self.notices: deque[Notice] = deque(maxlen=MAX_NOTICES)
        self.faults: deque[CanErrorFrame] = deque(maxlen=MAX_NOTICES)
        self._others: dict[int, tuple[int, ...]] = {}
        """The receivers of the frames of each node. Computed again when a node joins or leaves the bus, or enters bus-off."""
        self._joined_ns = 0
        """The time at which the newest node joined."""

    def join(self, number: int, node: Node) -> None:
        """Add a node from `node.joined_ns` on; nodes are added in order of time."""
        self.nodes[number] = node
        self._joined_ns = node.joined_ns
        self._others.clear()

    def leave(self, number: int) -> None:
        """Mark a node as having left: it receives nothing more."""
        self.nodes[number].left = True
        self._others.clear()

    def duration_ns(self, bits: int) -> int:
        """Return the duration of `bits` bits in ns: 0 if frames are instant."""
        return 0 if self.instant else (bits * NS_PER_S + self.bitrate // 2) // self.bitrate

    def frame_ns(self, frame: CanFrame, bits: int) -> int:
        """Return the duration in ns of the first `bits` of `frame`, with those of its data phase at the data bit rate."""
        if not frame.brs or self.instant:
            return self.duration_ns(bits)
        first, end = data_phase(frame)
        fast = max(0, min(bits, end) - first)
        return self.duration_ns(bits - fast) + (fast * NS_PER_S + self.data_bitrate // 2) // self.data_bitrate

    def busy(self, frame: CanFrame, bits: int, rest: int) -> tuple[int, int]:
        """Return the duration in ns of the first `bits` of `frame` and `rest` further bits, and this duration in bits at the
        nominal bit rate.

        The bits after a frame, or after an error in it, are always sent at the nominal bit rate.
        """
        if not frame.brs or self.instant:
            return self.duration_ns(bits + rest), bits + rest
        ns = self.frame_ns(frame, bits) + self.duration_ns(rest)
        return ns, -(-ns * self.bitrate // NS_PER_S)

    def attempt(self, start: Start) -> None:
        """Complete an attempt as a frame or an error. A node that enters bus-off counts from the end of the attempt on."""
        self._resolve(start)
        for number in start.rivals:
            node = self.nodes.get(number)
            if node is None or node.faults.state is _ACTIVE:
                continue  # the usual case
            if node.faults.state is CanErrorState.BUS_OFF:
                self._go_off(number)
            elif node.faults.state is CanErrorState.PASSIVE:
                node.hold_ns = self.free_ns + self.duration_ns(SUSPEND_BITS)

    def _resolve(self, start: Start) -> None:
        frame: CanFrame = start.winner.frame
        senders: Sequence[int] = start.rivals
        if len(senders) > 1:
            resolved = self._contend(start)
            if resolved is None:
                return
            frame, senders = resolved
        receivers = self._receivers(start, start.rivals)
        if self.rules and (what := self._asked(frame, start.start_ns, tuple(senders))) is not None:
            if self._spoilt(what, frame, start, senders, receivers):
                return
            receivers = [number for number in receivers if number not in what.seen_by]
        if self.monitored or self.instant or any(not self.nodes[number].listen_only for number in receivers):
            self._deliver(frame, start, senders, receivers)
        else:
            self._unacknowledged(frame, start, senders)

    def _receivers(self, start: Start, but: Sequence[int]) -> Sequence[int]:
        since_ns = start.start_ns
        # Kept per sender: without it a frame on a bus of 102 nodes takes a fifth longer.
        usual = len(but) == 1 and not self.off and since_ns >= self._joined_ns
        if usual and (known := self._others.get(but[0])) is not None:
            return known
        there = tuple(
            n for n, node in self.nodes.items() if n not in but and not node.left and node.joined_ns <= since_ns
        )
        if usual:
            self._others[but[0]] = there
        return [number for number in there if number not in self.off] if self.off else there

    def _contend(self, start: Start) -> tuple[CanFrame, list[int]] | None:
        """Resolve an arbitration that several nodes won.

        Return the remaining frame and its senders; None if the attempt ended in an error.
        """
        heads = {number: self.waiting[number].queue[0] for number in start.rivals}
        by_age = sorted(start.rivals, key=lambda number: heads[number].sequence)
        content = start.winner.frame.key()
        same = [number for number in by_age if heads[number].frame.key() == content]
        if len(same) == len(by_age):
            return start.winner.frame, same
        self.conflicts += 1
        if self.instant:
            return start.winner.frame, same
        outcome = can_verdict.collide(
            {number: heads[number].frame for number in by_age},
            lambda number: self.nodes[number].flags_are_dominant,
        )
        frame = heads[outcome.senders[0]].frame
        if outcome.error_bit is not None:
            verdict = can_verdict.collided(frame, outcome.error_bit)
            self._fail(verdict, frame, start, by_age, self._receivers(start, by_age))
            return None
        at_ns = start.start_ns + self.frame_ns(frame, outcome.lost_bit + 1)
        for number in outcome.losers:  # these nodes are error-passive: they stop sending without destroying the frame
            node = self.nodes[number]
            self.change(number, at_ns, node.faults.send_failed)
            node.errors += 1
        return frame, list(outcome.senders)

    def _asked(self, frame: CanFrame, start_ns: int, senders: tuple[int, ...]) -> Disturbance | None:
        for rule in self.rules:
            if (what := rule(frame, start_ns, senders)) is not None:
                return what
        return None

    def _spoilt(
        self, what: Disturbance, frame: CanFrame, start: Start, senders: Sequence[int], receivers: Sequence[int]
    ) -> bool:
        """Apply a disturbance, and return whether it destroyed the frame. If not, some error-passive receivers did not receive
        the frame.
        """
        victims = what.seen_by & set(receivers)
        at_sender = not what.seen_by or bool(what.seen_by & set(senders))
        if not at_sender and not any(self.nodes[n].flags_are_dominant for n in victims):
            for number in victims:
                at_ns = start.start_ns + self.frame_ns(frame, bits_to_end(frame))
                self.change(number, at_ns, partial(self.nodes[number].faults.receive_failed, first=False))
                self.nodes[number].errors += 1
            return False
        verdict = can_verdict.disturbed(what, frame, victims, at_sender=at_sender)
        self._fail(verdict, frame, start, senders, receivers)
        return True

    def _unacknowledged(self, frame: CanFrame, start: Start, senders: Sequence[int]) -> None:
        self._fail(can_verdict.unacknowledged(frame), frame, start, senders, [])
        for number in senders:
            if self.nodes[number].left:  # the process of this node has ended: do not repeat its frame
                self.nodes[number].queue.clear()
                self.stop_waiting(number)
                self.forget_if_done(number)

    def _fail(
        self, verdict: FailedAttempt, frame: CanFrame, start: Start, senders: Sequence[int], receivers: Sequence[int]
    ) -> None:
        """Send an error frame, which all participants count; the frame stays at the head of its queue."""
        at_ns = start.start_ns + self.frame_ns(frame, verdict.flag_at)
        took_ns, bits = self.busy(frame, verdict.flag_at, verdict.bits - verdict.flag_at)
        self._pass(start.start_ns, took_ns)
        for number in senders:
            faults = self.nodes[number].faults
            self.change(number, at_ns, faults.not_acknowledged if verdict.kind == "ack" else faults.send_failed)
        for number in receivers:
            first = number in verdict.first
            self.change(number, at_ns, partial(self.nodes[number].faults.receive_failed, first=first))
        self.error_frames += 1
        self.load.count(frame, bits, at_ns, tuple(senders), whole=False)
        counters = []
        for number in (*senders, *receivers):
            node = self.nodes[number]
            node.errors += 1
            counters.append((number, node.faults.tec, node.faults.rec))
        self.faults.append(
            CanErrorFrame(at_ns, verdict.kind, frame, start.start_ns, bits, tuple(senders), tuple(counters))
        )

    def _deliver(self, frame: CanFrame, start: Start, senders: Sequence[int], receivers: Sequence[int]) -> None:
        # already determined if there is a single sender
        length = start.bits if len(start.rivals) == 1 else bits_to_end(frame)
        took_ns, bits = self.busy(frame, length, INTERFRAME_BITS)
        end_ns = start.end_ns if len(start.rivals) == 1 else start.start_ns + self.frame_ns(frame, length)
        self._pass(start.start_ns, took_ns)
        sent_by = tuple(senders)
        self.load.count(frame, bits, end_ns, sent_by, whole=True)
        self.done.append(Delivery(frame.at(end_ns), start.start_ns, bits, sent_by, tuple(receivers)))
        for number in receivers:
            node = self.nodes[number]
            node.received += 1
            if node.faults.rec:
                self.change(number, end_ns, node.faults.received)
        for number in senders:
            node = self.nodes[number]
            node.queue.popleft()
            node.sent += 1
            if node.faults.tec:
                self.change(number, end_ns, node.faults.sent)
            if not node.queue:
                self.stop_waiting(number)
                if node.left:
                    self.forget_if_done(number)

    # -- error states ---------------------------------------------------------------------------------------------

    def change(self, number: int, at_ns: int, what: Callable[[], None]) -> None:
        faults = self.nodes[number].faults
        before = faults.state
        what()
        if faults.state is not before:
            self.notices.append(Notice(at_ns, number, before, faults.state, faults.tec, faults.rec))

    def _pass(self, start_ns: int, took_ns: int) -> None:
        """Record that an attempt occupied the bus for `took_ns`, in which nodes in bus-off count the recessive sequences."""
        if self.off:
            idle_bits = 0 if self.instant else (start_ns - self.free_ns) * self.bitrate // NS_PER_S
            self.off.attempt_passed(idle_bits)
        self.free_ns = start_ns + took_ns

    def _go_off(self, number: int) -> None:
        self.off.enter(number)
        self.stop_waiting(number)
        if self.nodes[number].left:
            self.nodes[number].queue.clear()
            self.forget_if_done(number)

    def stop_waiting(self, number: int) -> None:
        """Exclude a node from arbitration until it is added to `waiting` again."""
        self.waiting.pop(number, None)

    def forget_if_done(self, number: int) -> None:
        """Remove a node that has left, once its queue is empty."""
        if self.nodes[number].left and not self.nodes[number].queue:
            del self.nodes[number]
            self._others.clear()
            self.off.forget(number)
