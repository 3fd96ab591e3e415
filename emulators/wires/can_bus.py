"""A CAN bus as a model: who may send, when each frame ends, who receives it, and what errors do to it.

Pure: nodes submit frames and time is passed in, deliveries and notices come out. It knows no sockets, tasks or clocks, so the
same model runs behind a TCP server and under virtual time.

What is modelled: bitwise arbitration among the heads of the nodes' transmit queues, the exact stuffed length of each frame, the
interframe space, broadcast to every other node at the end of the frame; error frames and retransmission, each node's error
counters, error-passive with its suspended transmission, bus-off and recovery. A frame that is on the wire is never interrupted
by another. The outcome depends only on what was submitted when, never on how often `advance` is called: an attempt is judged when
the regular end of its frame has passed, and only frames that were there at its start took part in its arbitration.

Two nodes that send the very same frame at the same start overlap bit by bit: one frame on the wire, both have sent it (CiA 305
relies on that). The same arbitration field with other content is a bit error at the first bit that differs: an error frame and
TEC + 8 for both, again and again, until the one that sends the recessive bit is error-passive and can object no longer.

A frame that nobody acknowledges is sent again for ever; its sender becomes error-passive and never bus-off. By default the bus
itself acknowledges every frame (`monitored`), as on a test bench where an analyser always listens.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Sequence
from functools import partial
from typing import Any

from emulators.wires import can_verdict
from emulators.wires.can_events import Delivery, Notice, WireFault
from emulators.wires.can_faults import SUSPEND_BITS, Disturbance, Rule
from emulators.wires.can_load import BusLoad
from emulators.wires.can_nodes import BusOff, Node, Pending, Start
from emulators.wires.can_timing import (
    arbitration_key,
    bits_on_wire,
    bits_to_end,
)
from emulators.wires.can_verdict import Verdict
from gateway.core.can_error import CanErrorState
from gateway.core.canframe import CanFrame
from gateway.core.clock import NS_PER_S
from gateway.core.errors import Bug, EndpointBusy, UsageError

MAX_BITRATE = 1_000_000
MAX_NOTICES = 4096
"""Notices and errors kept until somebody takes them; older ones go first."""


class CanBus:
    """The bus. `now_ns` is monotonic over all calls.

    `queue_frames` bounds each node's transmit queue. `instant` makes frames take no time (they are still arbitrated and
    counted), for tests and imports that should not wait for a wire: without bits there are no collisions, of two frames with one
    arbitration field the older goes first. `monitored`: the bus acknowledges every frame; otherwise only other nodes do.
    """

    def __init__(
        self,
        bitrate: int,
        *,
        instant: bool = False,
        queue_frames: int = 64,
        max_nodes: int = 128,
        monitored: bool = True,
    ) -> None:
        if not 1 <= bitrate <= MAX_BITRATE:
            raise UsageError("bit rate of a CAN bus", expected=f"1 to {MAX_BITRATE} bit/s", got=str(bitrate))
        self.bitrate = bitrate
        self.instant = instant
        self.queue_frames = queue_frames
        self.max_nodes = max_nodes
        self.monitored = monitored
        self.conflicts = 0
        """Attempts in which nodes sent one arbitration field with different content."""
        self.error_frames = 0
        self.overruns = 0
        self._load = BusLoad(bitrate)
        self._nodes: dict[int, Node] = {}
        self._waiting: dict[int, Node] = {}  # those with something to send, and on the bus
        self._off = BusOff()
        self._next_node = 1
        self._sequence = 0
        self._free_ns = 0  # when the interframe space of the last attempt ends
        self._next: Start | None = None  # cached: see `_upcoming`
        self._rules: list[Rule] = []
        self._done: list[Delivery] = []
        self._notices: deque[Notice] = deque(maxlen=MAX_NOTICES)
        self._faults: deque[WireFault] = deque(maxlen=MAX_NOTICES)

    # -- nodes ----------------------------------------------------------------------------------------------------

    def join(self, now_ns: int, name: str = "", *, listen_only: bool = False) -> int:
        """A new node's number. It receives frames that start from now on. Raises `EndpointBusy` when the bus is full.

        With `listen_only` it never acknowledges nor objects, and may not send.
        """
        if len(self._nodes) >= self.max_nodes:
            raise EndpointBusy("the CAN bus is full", expected=f"at most {self.max_nodes} nodes")
        self._run(now_ns)
        node = self._next_node
        self._next_node += 1
        self._nodes[node] = Node(name or f"node {node}", now_ns, listen_only=listen_only)
        return node

    def leave(self, node: int, now_ns: int) -> None:
        """The node receives nothing more. What it queued still goes out, as a kernel sends what a closed socket left."""
        self._run(now_ns)
        self._node(node).left = True
        if node in self._off:
            self._node(node).queue.clear()
        self._forget_if_done(node)

    def submit(self, node: int, frame: CanFrame, now_ns: int) -> bool:
        """Queue `frame` for transmission; False (and nothing queued) while the node's transmit queue is full.

        Frames of one node keep their order. In bus-off they wait. Error frames are the bus's own: `UsageError`.
        """
        if frame.error:
            raise UsageError("a node cannot send an error frame", got=str(frame))
        sender = self._node(node)
        if sender.listen_only:
            raise UsageError("a node that only listens cannot send", got=str(frame))
        if len(sender.queue) >= self.queue_frames:
            self._run(now_ns)  # what ended by now no longer takes a place
            if len(sender.queue) >= self.queue_frames:
                sender.refused += 1
                return False
        self._sequence += 1
        sender.queue.append(Pending(frame, now_ns, self._sequence, arbitration_key(frame)))
        if len(sender.queue) == 1 and node not in self._off:
            self._waiting[node] = sender
            if self._next is not None and now_ns <= self._next.start_ns:
                self._next = None  # it takes part in that arbitration
        return True

    def queued(self, node: int) -> int:
        """Frames that wait in the node's transmit queue, the one on the wire included."""
        return len(self._node(node).queue)

    def count_overrun(self, node: int) -> None:
        """The node could not take a frame that was delivered to it."""
        self.overruns += 1
        self._node(node).overruns += 1

    def error_state(self, node: int) -> tuple[CanErrorState, int, int]:
        """The node's state, TEC and REC as of the last `advance`."""
        faults = self._node(node).faults
        return faults.state, faults.tec, faults.rec

    def disturb(self, rule: Rule) -> None:
        """Spoil attempts as `rule` says (`can_faults.spoil` makes one). The first rule that answers decides."""
        self._rules.append(rule)

    def undisturb(self, rule: Rule) -> None:
        """Take a rule away; one that is not there is no error."""
        if rule in self._rules:
            self._rules.remove(rule)

    # -- time -----------------------------------------------------------------------------------------------------

    def advance(self, now_ns: int) -> list[Delivery]:
        """The frames that ended up to `now_ns`, in the order of the wire; each is returned once."""
        self._run(now_ns)
        done, self._done = self._done, []
        return done

    @property
    def has_news(self) -> bool:
        """Whether there are deliveries, notices or faults that nobody took yet."""
        return bool(self._done or self._notices or self._faults)

    def take_notices(self) -> list[Notice]:
        """The changes of state up to the last `advance`, in order; each is returned once."""
        notices = list(self._notices)
        self._notices.clear()
        return notices

    def take_faults(self) -> list[WireFault]:
        """The error frames up to the last `advance`, in order; each is returned once."""
        faults = list(self._faults)
        self._faults.clear()
        return faults

    def next_event_ns(self) -> int | None:
        """When `advance` will have something, as things stand; None while nothing will come of itself.

        A frame submitted meanwhile can change it only if the bus is idle until then; an error brings it forward.
        """
        if self._done:
            return self._done[0].frame.t_ns
        recovery = self._recovery_ns()
        start = self._upcoming()
        if start is None or self._idles(start):
            return recovery
        return start.end_ns if recovery is None else min(start.end_ns, recovery)

    def _run(self, now_ns: int) -> None:
        while True:
            start = self._upcoming()
            recovery_ns = self._recovery_ns() if self._off else None
            if recovery_ns is not None and recovery_ns <= now_ns and (start is None or recovery_ns <= start.start_ns):
                self._recover(recovery_ns)
            elif start is None or start.end_ns > now_ns:
                return
            elif not (self._idles(start) and self._skip(start, now_ns, recovery_ns)):
                self._attempt(start)

    def _upcoming(self) -> Start | None:
        if self._next is None and self._waiting:
            heads = [(max(node.queue[0].ready_ns, node.hold_ns), number) for number, node in self._waiting.items()]
            start_ns = max(self._free_ns, min(heads)[0])
            contenders = [number for ready_ns, number in heads if ready_ns <= start_ns]
            winner = min((self._waiting[n].queue[0] for n in contenders), key=lambda p: (p.key, p.sequence))
            rivals = [n for n in contenders if self._waiting[n].queue[0].key == winner.key]
            longest = bits_to_end(winner.frame)
            if len(rivals) > 1:  # of a collision, any may stay
                longest = max(bits_to_end(self._waiting[n].queue[0].frame) for n in rivals)
            end_ns = start_ns + self._duration_ns(longest)
            self._next = Start(start_ns, end_ns, winner, rivals)
        return self._next

    # -- attempts -------------------------------------------------------------------------------------------------

    def _attempt(self, start: Start) -> None:
        """An attempt's regular end has come: it was a frame, or an error. Who is in bus-off by it counts from its end on."""
        self._next = None
        self._judge(start)
        for number in start.rivals:
            node = self._nodes.get(number)
            if node is not None and node.faults.state is CanErrorState.BUS_OFF:
                self._go_off(number)
            elif node is not None and node.faults.state is CanErrorState.PASSIVE:
                node.hold_ns = self._free_ns + self._duration_ns(SUSPEND_BITS)

    def _judge(self, start: Start) -> None:
        if len(start.rivals) == 1:
            frame, senders = start.winner.frame, start.rivals
        else:
            resolved = self._contend(start)
            if resolved is None:
                return
            frame, senders = resolved
        receivers = self._receivers(start, start.rivals)
        if self._rules and (what := self._asked(frame, start.start_ns, tuple(senders))) is not None:
            if self._spoilt(what, frame, start, senders, receivers):
                return
            receivers = [number for number in receivers if number not in what.seen_by]
        if self.monitored or self.instant or any(not self._nodes[number].listen_only for number in receivers):
            self._deliver(frame, start, senders, receivers)
        else:
            self._unacknowledged(frame, start, senders)

    def _receivers(self, start: Start, but: Collection[int]) -> list[int]:
        since_ns = start.start_ns
        there = [n for n, node in self._nodes.items() if n not in but and not node.left and node.joined_ns <= since_ns]
        return [number for number in there if number not in self._off] if self._off else there

    def _contend(self, start: Start) -> tuple[CanFrame, list[int]] | None:
        """Several nodes won the arbitration together. The frame that stays and who sends it; None: it came to an error."""
        heads = {number: self._waiting[number].queue[0] for number in start.rivals}
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
            lambda number: self._nodes[number].flags_are_dominant,
        )
        frame = heads[outcome.senders[0]].frame
        if outcome.error_bit is not None:
            verdict = can_verdict.collided(frame, outcome.error_bit)
            self._fail(verdict, frame, start, by_age, self._receivers(start, by_age))
            return None
        at_ns = start.start_ns + self._duration_ns(outcome.lost_bit + 1)
        for number in outcome.losers:  # error-passive: they give way without spoiling the frame
            node = self._nodes[number]
            self._change(number, at_ns, node.faults.send_failed)
            node.errors += 1
        return frame, list(outcome.senders)

    def _asked(self, frame: CanFrame, start_ns: int, senders: tuple[int, ...]) -> Disturbance | None:
        for rule in self._rules:
            if (what := rule(frame, start_ns, senders)) is not None:
                return what
        return None

    def _spoilt(
        self, what: Disturbance, frame: CanFrame, start: Start, senders: list[int], receivers: list[int]
    ) -> bool:
        """Whether the disturbance destroyed the frame; if not, some error-passive receivers went without it."""
        victims = what.seen_by & set(receivers)
        at_sender = not what.seen_by or bool(what.seen_by & set(senders))
        if not at_sender and not any(self._nodes[n].flags_are_dominant for n in victims):
            for number in victims:
                at_ns = start.start_ns + self._duration_ns(bits_to_end(frame))
                self._change(number, at_ns, partial(self._nodes[number].faults.receive_failed, first=False))
                self._nodes[number].errors += 1
            return False
        verdict = can_verdict.disturbed(what, frame, victims, at_sender=at_sender)
        self._fail(verdict, frame, start, senders, receivers)
        return True

    def _unacknowledged(self, frame: CanFrame, start: Start, senders: list[int]) -> None:
        self._fail(can_verdict.unacknowledged(frame), frame, start, senders, [])
        for number in senders:
            if self._nodes[number].left:  # its process is gone: nobody tries for ever on its behalf
                self._nodes[number].queue.clear()
                self._stop_waiting(number)
                self._forget_if_done(number)

    def _fail(
        self, verdict: Verdict, frame: CanFrame, start: Start, senders: Sequence[int], receivers: Sequence[int]
    ) -> None:
        """An error frame, that all who take part count; what was to be sent stays at the head of its queue."""
        at_ns = start.start_ns + self._duration_ns(verdict.flag_at)
        self._pass(start.start_ns, verdict.bits)
        for number in senders:
            faults = self._nodes[number].faults
            self._change(number, at_ns, faults.not_acknowledged if verdict.kind == "ack" else faults.send_failed)
        for number in receivers:
            first = number in verdict.first
            self._change(number, at_ns, partial(self._nodes[number].faults.receive_failed, first=first))
        self.error_frames += 1
        self._load.count(frame, verdict.bits, at_ns, tuple(senders), whole=False)
        counters = []
        for number in (*senders, *receivers):
            node = self._nodes[number]
            node.errors += 1
            counters.append((number, node.faults.tec, node.faults.rec))
        self._faults.append(
            WireFault(at_ns, verdict.kind, frame, start.start_ns, verdict.bits, tuple(senders), tuple(counters))
        )

    def _deliver(self, frame: CanFrame, start: Start, senders: list[int], receivers: list[int]) -> None:
        bits = bits_on_wire(frame)
        end_ns = start.start_ns + self._duration_ns(bits_to_end(frame))
        self._pass(start.start_ns, bits)
        self._load.count(frame, bits, end_ns, tuple(senders), whole=True)
        ended = CanFrame(frame.can_id, frame.data, frame.extended, frame.remote, dlc=frame.dlc, t_ns=end_ns)
        self._done.append(Delivery(ended, start.start_ns, bits, tuple(senders), tuple(receivers)))
        for number in receivers:
            node = self._nodes[number]
            node.received += 1
            if node.faults.rec:
                self._change(number, end_ns, node.faults.received)
        for number in senders:
            node = self._nodes[number]
            node.queue.popleft()
            node.sent += 1
            if node.faults.tec:
                self._change(number, end_ns, node.faults.sent)
            if not node.queue:
                self._stop_waiting(number)
                self._forget_if_done(number)

    # -- error states ---------------------------------------------------------------------------------------------

    def _change(self, number: int, at_ns: int, what: Callable[[], None]) -> None:
        faults = self._nodes[number].faults
        before = faults.state
        what()
        if faults.state is not before:
            self._notices.append(Notice(at_ns, number, before, faults.state, faults.tec, faults.rec))

    def _pass(self, start_ns: int, bits: int) -> None:
        """An attempt took the bus: it is free again after `bits`. Nodes in bus-off count the recessive sequences."""
        if self._off:
            idle_bits = 0 if self.instant else (start_ns - self._free_ns) * self.bitrate // NS_PER_S
            self._off.attempt_passed(idle_bits)
        self._free_ns = start_ns + self._duration_ns(bits)

    def _go_off(self, number: int) -> None:
        self._off.enter(number)
        self._stop_waiting(number)
        if self._nodes[number].left:
            self._nodes[number].queue.clear()
            self._forget_if_done(number)

    def _recovery_ns(self) -> int | None:
        """When the next node in bus-off is back, if nobody sends until then."""
        if not self._off:
            return None
        return self._free_ns + self._duration_ns(self._off.bits_to_recovery())

    def _recover(self, at_ns: int) -> None:
        number = self._off.take_recovered()
        node = self._nodes[number]
        node.hold_ns = at_ns
        self._change(number, at_ns, node.faults.recover)
        if node.queue:
            self._waiting[number] = node
            self._next = None

    def _idles(self, start: Start) -> bool:
        """Whether the attempt changes nothing: a lone error-passive node that nobody acknowledges tries for ever."""
        if self.monitored or self.instant or self._rules or len(start.rivals) != 1 or len(self._waiting) != 1:
            return False
        lone = self._nodes[start.rivals[0]]
        return (
            lone.faults.state is CanErrorState.PASSIVE
            and not lone.left
            and all(n in self._off or m is lone or m.left or m.listen_only for n, m in self._nodes.items())
        )

    def _skip(self, start: Start, now_ns: int, recovery_ns: int | None) -> bool:
        """Pass over attempts that change nothing, all that end before `now_ns` and before a node is back."""
        bits = can_verdict.unacknowledged(start.winner.frame).bits
        period_ns = self._duration_ns(bits + SUSPEND_BITS)
        if recovery_ns is not None or period_ns == 0:
            return False
        attempts = (now_ns - start.start_ns) // period_ns
        if attempts < 2:
            return False
        number = start.rivals[0]
        self._nodes[number].errors += attempts - 1
        self.error_frames += attempts - 1
        self._nodes[number].hold_ns = start.start_ns + (attempts - 1) * period_ns
        self._free_ns = self._nodes[number].hold_ns - self._duration_ns(SUSPEND_BITS)
        self._next = None
        return True

    # -- counting -------------------------------------------------------------------------------------------------

    @property
    def frames(self) -> int:
        """Frames that went over the bus."""
        return self._load.frames

    @property
    def bits(self) -> int:
        """Bits that kept it busy."""
        return self._load.bits

    def load(self, now_ns: int) -> float:
        """Share of the last second's bits that carried something, 0 to 1 (more is possible where frames are instant)."""
        return self._load.total(now_ns)

    def stats(self, now_ns: int) -> dict[str, Any]:
        """Totals, per node and per identifier (as candump writes it); JSON-able.

        ``frames``, ``bits`` (stuffed, with interframe space and errors), ``load`` (0 to 1, last second), ``overruns``,
        ``conflicts``, ``error_frames``, ``bitrate``, ``by_id`` (frames), ``load_by_id`` and ``nodes``: a list of node, name,
        sent, received, overruns, refused, queued, load, errors, state, tec, rec.
        """
        load_by_node = self._load.by_node(now_ns)
        return {
            "bitrate": self.bitrate,
            "frames": self.frames,
            "bits": self.bits,
            "load": self.load(now_ns),
            "overruns": self.overruns,
            "conflicts": self.conflicts,
            "error_frames": self.error_frames,
            "by_id": dict(self._load.by_id),
            "load_by_id": self._load.by_identifier(now_ns),
            "nodes": [node.as_dict(number, load_by_node.get(number, 0.0)) for number, node in self._nodes.items()],
        }

    # -- small things ---------------------------------------------------------------------------------------------

    def _duration_ns(self, bits: int) -> int:
        return 0 if self.instant else (bits * NS_PER_S + self.bitrate // 2) // self.bitrate

    def _node(self, node: int) -> Node:
        try:
            return self._nodes[node]
        except KeyError:
            raise Bug("a node that is not on the CAN bus", got=str(node)) from None

    def _stop_waiting(self, node: int) -> None:
        self._waiting.pop(node, None)

    def _forget_if_done(self, node: int) -> None:
        if self._nodes[node].left and not self._nodes[node].queue:
            del self._nodes[node]
            self._off.forget(node)
