"""A model of a CAN bus: which node may send, when each frame ends, which nodes receive it, and the effects of errors.

Nodes submit frames and the caller passes the time; the results are deliveries and notices. The model uses no sockets, tasks or
clocks, so the same model runs behind a TCP server and in virtual time.

The model covers: bitwise arbitration among the heads of the nodes' transmit queues, the exact stuffed length of each
frame, the interframe space, broadcast to every other node at the end of the frame; error frames and retransmission,
each node's error counters, error-passive with its suspended transmission, bus-off and recovery. A frame that is being sent is
never interrupted by another frame. The outcome depends only on the times of submission, never on how often `advance` is
called: an attempt is evaluated after the regular end of its frame, and only frames that were queued at its start take part in
its arbitration.

Two nodes that send identical frames at the same start overlap bit by bit: the bus carries one frame, and both nodes have sent
it (CiA 305 relies on that). The same arbitration field with different content is a bit error at the first bit that differs: an
error frame and TEC + 8 for both, repeatedly, until the node that sends the recessive bit is error-passive and cannot object
any more.

A frame without an acknowledgement is retransmitted without end; its sender becomes error-passive and never bus-off. By
default the bus itself acknowledges every frame (`monitored`), as on a test bench where an analyser always listens.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

from fieldtwin.emulators.wires import can_verdict
from fieldtwin.emulators.wires.can_attempts import Attempts
from fieldtwin.emulators.wires.can_events import CanErrorFrame, Delivery, Notice
from fieldtwin.emulators.wires.can_faults import SUSPEND_BITS, ErrorRule
from fieldtwin.emulators.wires.can_nodes import Node, Pending, Start
from fieldtwin.emulators.wires.can_timing import arbitration_key, bits_to_end
from fieldtwin.gateway.core.can_error import CanErrorState
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.errors import Bug, EndpointBusy, UsageError

MAX_BITRATE, MAX_DATA_BITRATE = 1_000_000, 8_000_000


class CanBus:
    """The bus. `now_ns` is monotonic over all calls.

    `queue_frames` limits each node's transmit queue. `instant` makes frames take no time (they are still arbitrated and
    counted), for tests and imports that should not wait for a bus. Such frames have no bits that could collide: of two frames
    with the same arbitration field the older is sent first. `data_bitrate` is that of CAN FD frames with the bit-rate
    switch, 0 for `bitrate`. `monitored`: the bus acknowledges every frame; otherwise only other nodes do.
    """

    def __init__(
        self,
        bitrate: int,
        *,
        instant: bool = False,
        queue_frames: int = 64,
        max_nodes: int = 128,
        monitored: bool = True,
        data_bitrate: int = 0,
    ) -> None:
        if not 1 <= bitrate <= MAX_BITRATE:
            raise UsageError("bit rate of a CAN bus", expected=f"1 to {MAX_BITRATE} bit/s", got=str(bitrate))
        if data_bitrate and not bitrate <= data_bitrate <= MAX_DATA_BITRATE:
            raise UsageError(
                "data bit rate of a CAN bus", expected=f"{bitrate} to {MAX_DATA_BITRATE} bit/s", got=str(data_bitrate)
            )
        self.bitrate = bitrate
        self.data_bitrate = data_bitrate or bitrate
        self.instant = instant
        self.queue_frames = queue_frames
        self.max_nodes = max_nodes
        self.monitored = monitored
        self.overruns = 0
        self._wire = Attempts(bitrate, instant=instant, monitored=monitored, data_bitrate=data_bitrate)
        self._next_node = 1
        self._sequence = 0
        self._next: Start | None = None  # cached: see `_upcoming`

    # -- nodes ----------------------------------------------------------------------------------------------------

    def join(self, now_ns: int, name: str = "", *, listen_only: bool = False) -> int:
        """Add a node and return its number. It receives frames that start from now on. Raises `EndpointBusy` if the bus
        is full.

        With `listen_only` the node never acknowledges, never sends an error flag, and may not send.
        """
        if len(self._wire.nodes) >= self.max_nodes:
            raise EndpointBusy("the CAN bus is full", expected=f"at most {self.max_nodes} nodes")
        self._run(now_ns)
        node = self._next_node
        self._next_node += 1
        self._wire.join(node, Node(name or f"node {node}", now_ns, listen_only=listen_only))
        return node

    def leave(self, node: int, now_ns: int) -> None:
        """Remove a node, which receives nothing more.

        Its queued frames are still sent, as a kernel does for a closed socket.
        """
        self._run(now_ns)
        leaving = self._node(node)
        self._wire.leave(node)
        if node in self._wire.off:
            leaving.queue.clear()
        self._wire.forget_if_done(node)

    def submit(self, node: int, frame: CanFrame, now_ns: int, *, counted: bool = True) -> bool:
        """Queue `frame` for transmission; return False (and queue nothing) while the node's transmit queue is full.

        Set `counted` to False if the caller retries this frame, so that the refusal is not counted. Frames of one node keep their
        order. In bus-off they wait. Raises `UsageError` for an error frame, because only the bus itself sends those.
        """
        if frame.error:
            raise UsageError("a node cannot send an error frame", got=str(frame))
        sender = self._node(node)
        if sender.listen_only:
            raise UsageError("a listen-only node cannot send", got=str(frame))
        if len(sender.queue) >= self.queue_frames:
            self._run(now_ns)  # frames that have ended by now leave their places in the queues
            if len(sender.queue) >= self.queue_frames:
                sender.refused += counted
                return False
        self._sequence += 1
        sender.queue.append(Pending(frame, now_ns, self._sequence, arbitration_key(frame)))
        if len(sender.queue) == 1 and node not in self._wire.off:
            self._wire.waiting[node] = sender
            if self._next is not None and now_ns <= self._next.start_ns:
                self._next = None  # the new frame takes part in the next arbitration
        return True

    def withdraw(self, node: int, can_ids: Collection[int], now_ns: int) -> list[CanFrame]:
        """Withdraw data frames with `can_ids` (11 bits) from the node's transmit queue, as a controller aborts its
        mailboxes.

        A frame that is being sent stays. Returns the withdrawn frames in order.
        """
        self._run(now_ns)
        owner, start = self._node(node), self._upcoming()
        begun = start is not None and start.start_ns < now_ns
        safe = 1 if begun and start is not None and node in start.rivals else 0
        waiting = list(owner.queue)
        taken = [p for p in waiting[safe:] if p.frame.can_id in can_ids and not (p.frame.extended or p.frame.remote)]
        if taken:
            owner.queue.clear()
            owner.queue.extend(p for p in waiting if p not in taken)
            if not begun:
                self._next = None
            if not owner.queue:
                self._wire.stop_waiting(node)
                self._wire.forget_if_done(node)
        return [p.frame for p in taken]

    def queued(self, node: int) -> int:
        """Return the number of frames in the node's transmit queue, including the frame that is being sent."""
        return len(self._node(node).queue)

    def count_overrun(self, node: int) -> None:
        """Count a frame that the node lost because it had no room to receive it."""
        self.overruns += 1
        self._node(node).overruns += 1

    def error_state(self, node: int) -> tuple[CanErrorState, int, int]:
        """Return the node's state, TEC and REC as of the last `advance`."""
        faults = self._node(node).faults
        return faults.state, faults.tec, faults.rec

    def disturb(self, rule: ErrorRule) -> None:
        """Destroy attempts as `rule` says (`can_faults.spoil` creates one).

        The first rule that returns a disturbance decides.
        """
        self._wire.rules.append(rule)

    def undisturb(self, rule: ErrorRule) -> None:
        """Remove a rule; an unknown rule is ignored."""
        if rule in self._wire.rules:
            self._wire.rules.remove(rule)

    # -- time -----------------------------------------------------------------------------------------------------

    def advance(self, now_ns: int) -> list[Delivery]:
        """Return the frames that ended up to `now_ns`, in the order in which they were sent; each is returned once."""
        self._run(now_ns)
        done, self._wire.done = self._wire.done, []
        return done

    @property
    def has_news(self) -> bool:
        """Return whether there are deliveries, notices or faults that have not been taken."""
        return bool(self._wire.done or self._wire.notices or self._wire.faults)

    def take_notices(self) -> list[Notice]:
        """Return the changes of state up to the last `advance`, in order; each is returned once."""
        notices = list(self._wire.notices)
        self._wire.notices.clear()
        return notices

    def take_faults(self) -> list[CanErrorFrame]:
        """Return the error frames up to the last `advance`, in order; each is returned once."""
        faults = list(self._wire.faults)
        self._wire.faults.clear()
        return faults

    def next_event_ns(self) -> int | None:
        """Return the time (ns) at which `advance` will next have a result; None if nothing will happen without a submission.

        A frame that is submitted earlier changes this time only if the bus is idle until then; an error makes the event earlier.
        """
        if self._wire.done:
            return self._wire.done[0].frame.t_ns
        start = self._next or (self._upcoming() if self._wire.waiting else None)
        recovery = self._recovery_ns() if self._wire.off else None
        if recovery is not None and (start is None or recovery <= start.start_ns):
            return recovery  # a frame that begins earlier postpones it, because the bus is not idle then
        if start is None or (recovery is None and not self.monitored and self._idles(start)):
            return None
        return start.end_ns

    def _run(self, now_ns: int) -> None:
        while True:
            start = self._next or (self._upcoming() if self._wire.waiting else None)
            recovery_ns = self._recovery_ns() if self._wire.off else None
            if recovery_ns is not None and recovery_ns <= now_ns and (start is None or recovery_ns <= start.start_ns):
                self._recover(recovery_ns)
            elif start is None or start.end_ns > now_ns:
                return
            elif self.monitored or not (self._idles(start) and self._skip(start, now_ns, recovery_ns)):
                self._next = None
                self._wire.attempt(start)

    def _upcoming(self) -> Start | None:
        if self._next is None and len(self._wire.waiting) == 1:  # no arbitration: saves a fifth of a frame's time
            ((number, node),) = self._wire.waiting.items()
            winner = node.queue[0]
            start_ns = max(self._wire.free_ns, winner.ready_ns, node.hold_ns)
            bits = bits_to_end(winner.frame)
            self._next = Start(start_ns, start_ns + self._wire.frame_ns(winner.frame, bits), bits, winner, (number,))
        elif self._next is None and self._wire.waiting:
            heads = [(max(node.queue[0].ready_ns, node.hold_ns), number) for number, node in self._wire.waiting.items()]
            start_ns = max(self._wire.free_ns, min(heads)[0])
            contenders = [number for ready_ns, number in heads if ready_ns <= start_ns]
            winner = min((self._wire.waiting[n].queue[0] for n in contenders), key=lambda p: (p.key, p.sequence))
            rivals = tuple(n for n in contenders if self._wire.waiting[n].queue[0].key == winner.key)
            frames = [self._wire.waiting[n].queue[0].frame for n in rivals]  # in a collision, any of them may remain
            longest = max(bits_to_end(frame) for frame in frames)
            end_ns = start_ns + max(self._wire.frame_ns(frame, bits_to_end(frame)) for frame in frames)
            self._next = Start(start_ns, end_ns, longest, winner, rivals)
        return self._next

    # -- bus-off, and attempts that change nothing ----------------------------------------------------------------

    def _recovery_ns(self) -> int | None:
        """Return the time (ns) at which the next node leaves bus-off if no node sends until then."""
        if not self._wire.off:
            return None
        return self._wire.free_ns + self._wire.duration_ns(self._wire.off.bits_to_recovery())

    def _recover(self, at_ns: int) -> None:
        number = self._wire.off.take_recovered()
        node = self._wire.nodes[number]
        node.hold_ns = at_ns
        self._wire.change(number, at_ns, node.faults.recover)
        if node.queue:
            self._wire.waiting[number] = node
            self._next = None

    def _idles(self, start: Start) -> bool:
        """Return whether the attempt changes nothing, because a lone error-passive node repeats a frame that no node
        acknowledges.
        """
        if self.monitored or self.instant or self._wire.rules or len(start.rivals) != 1 or len(self._wire.waiting) != 1:
            return False
        lone = self._wire.nodes[start.rivals[0]]
        return (
            lone.faults.state is CanErrorState.PASSIVE
            and not lone.left
            and all(n in self._wire.off or m is lone or m.left or m.listen_only for n, m in self._wire.nodes.items())
        )

    def _skip(self, start: Start, now_ns: int, recovery_ns: int | None) -> bool:
        """Skip attempts that change nothing and that end before `now_ns` and before a node leaves bus-off."""
        frame = start.winner.frame
        verdict = can_verdict.unacknowledged(frame)
        after = verdict.bits - verdict.flag_at + SUSPEND_BITS
        period_ns = self._wire.busy(frame, verdict.flag_at, after)[0]
        if recovery_ns is not None or period_ns == 0:
            return False
        attempts = (now_ns - start.start_ns) // period_ns
        if attempts < 2:
            return False
        number = start.rivals[0]
        self._wire.nodes[number].errors += attempts - 1
        self._wire.error_frames += attempts - 1
        self._wire.nodes[number].hold_ns = start.start_ns + (attempts - 1) * period_ns
        self._wire.free_ns = self._wire.nodes[number].hold_ns - self._wire.duration_ns(SUSPEND_BITS)
        self._next = None
        return True

    # -- counting -------------------------------------------------------------------------------------------------

    @property
    def conflicts(self) -> int:
        """Return the number of attempts in which nodes sent one arbitration field with different content."""
        return self._wire.conflicts

    @property
    def error_frames(self) -> int:
        return self._wire.error_frames

    @property
    def frames(self) -> int:
        """Return the number of frames that were sent on the bus."""
        return self._wire.load.frames

    @property
    def bits(self) -> int:
        """Return the number of bits for which the bus was busy."""
        return self._wire.load.bits

    def load(self, now_ns: int) -> float:
        """Return the load of the bus in the last second, 0 to 1 (or more if frames are instant)."""
        return self._wire.load.total(now_ns)

    def stats(self, now_ns: int) -> dict[str, Any]:
        """Return totals, values per node and per identifier (as candump writes it); JSON-able.

        ``frames``, ``bits`` (stuffed, with interframe space and errors), ``load`` (0 to 1, last second), ``overruns``,
        ``conflicts``, ``error_frames``, ``bitrate``, ``by_id`` (frames), ``load_by_id`` and ``nodes``: a list of node,
        name, sent, received, overruns, refused, queued, load, errors, state, tec, rec.
        """
        load_by_node = self._wire.load.by_node(now_ns)
        return {
            "bitrate": self.bitrate,
            "frames": self.frames,
            "bits": self.bits,
            "load": self.load(now_ns),
            "overruns": self.overruns,
            "conflicts": self.conflicts,
            "error_frames": self.error_frames,
            "by_id": dict(self._wire.load.by_id),
            "load_by_id": self._wire.load.by_identifier(now_ns),
            "nodes": [node.as_dict(number, load_by_node.get(number, 0.0)) for number, node in self._wire.nodes.items()],
        }

    # -- helpers --------------------------------------------------------------------------------------------------

    def _node(self, node: int) -> Node:
        try:
            return self._wire.nodes[node]
        except KeyError:
            raise Bug("a node that is not on the CAN bus", got=str(node)) from None
