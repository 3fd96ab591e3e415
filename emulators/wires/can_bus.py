"""A CAN bus as a model: who may send, when each frame ends, and who receives it.

Pure: nodes submit frames and time is passed in, deliveries come out. It knows no sockets, tasks or clocks, so the same
model runs behind a TCP server and under virtual time.

What is modelled: bitwise arbitration among the heads of the nodes' transmit queues, the exact stuffed length of each
frame, the interframe space, broadcast to every other node at the end of the frame. A frame that is on the wire is never
interrupted. The outcome depends only on what was submitted when, never on how often `advance` is called: a frame is
committed when its end has passed, and only frames that were there at its start took part in its arbitration.

Two nodes that send the very same frame at the same start overlap bit by bit: one frame on the wire, both have sent it
(CiA 305 relies on that). The same arbitration field with other content would be a bit error on a real bus; here the
older goes first, and `conflicts` counts it.
"""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass, field, replace
from typing import Any

from emulators.wires.can_timing import INTERFRAME_BITS, arbitration_key, bits_on_wire
from gateway.core.canframe import CanFrame
from gateway.core.clock import NS_PER_MS, NS_PER_S
from gateway.core.errors import Bug, EndpointBusy, UsageError

MAX_BITRATE = 1_000_000
MAX_IDS_COUNTED = 4096
"""Distinct identifiers with a count of their own; frames of further ones are counted together as ``other``."""

_SLOT_NS = 100 * NS_PER_MS
_SLOTS = 10  # the load is that of the last second


@dataclass(frozen=True, slots=True)
class Delivery:
    """One frame that went over the bus. `frame.t_ns` is its end of frame.

    `senders` have more than one node only where identical frames overlapped. `receivers` were on the bus at its start.
    """

    frame: CanFrame
    start_ns: int
    bits: int
    senders: tuple[int, ...]
    receivers: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class _Pending:
    frame: CanFrame
    ready_ns: int
    sequence: int
    key: int


@dataclass(slots=True)
class _Node:
    name: str
    joined_ns: int
    queue: deque[_Pending] = field(default_factory=deque)
    left: bool = False
    sent: int = 0
    received: int = 0
    overruns: int = 0
    refused: int = 0


class CanBus:
    """The bus. `now_ns` is monotonic over all calls.

    `queue_frames` bounds each node's transmit queue; `instant` makes frames take no time (they are still arbitrated and
    counted): for tests and imports that should not wait for a wire.
    """

    def __init__(self, bitrate: int, *, instant: bool = False, queue_frames: int = 64, max_nodes: int = 128) -> None:
        if not 1 <= bitrate <= MAX_BITRATE:
            raise UsageError("bit rate of a CAN bus", expected=f"1 to {MAX_BITRATE} bit/s", got=str(bitrate))
        self.bitrate = bitrate
        self.instant = instant
        self.queue_frames = queue_frames
        self.max_nodes = max_nodes
        self.frames = 0
        self.bits = 0
        self.conflicts = 0
        self.overruns = 0
        self._nodes: dict[int, _Node] = {}
        self._next_node = 1
        self._sequence = 0
        self._free_ns = 0  # when the interframe space of the last committed frame ends
        self._done: list[Delivery] = []
        self._by_id: Counter[str] = Counter()
        self._slots: deque[list[int]] = deque(maxlen=_SLOTS)  # [slot number, bits], newest last

    # -- nodes ----------------------------------------------------------------------------------------------------

    def join(self, now_ns: int, name: str = "") -> int:
        """A new node's number. It receives frames that start from now on. Raises `EndpointBusy` when the bus is full."""
        if len(self._nodes) >= self.max_nodes:
            raise EndpointBusy("the CAN bus is full", expected=f"at most {self.max_nodes} nodes")
        node = self._next_node
        self._next_node += 1
        self._nodes[node] = _Node(name or f"node {node}", now_ns)
        return node

    def leave(self, node: int, now_ns: int) -> None:
        """The node receives nothing more. What it queued still goes out, as a kernel sends what a closed socket left."""
        self._run(now_ns)
        self._node(node).left = True
        self._forget_if_done(node)

    def submit(self, node: int, frame: CanFrame, now_ns: int) -> bool:
        """Queue `frame` for transmission; False (and nothing queued) while the node's transmit queue is full.

        Frames of one node keep their order. Error frames are the bus's own: `UsageError`.
        """
        if frame.error:
            raise UsageError("a node cannot send an error frame", got=str(frame))
        sender = self._node(node)
        if len(sender.queue) >= self.queue_frames:
            self._run(now_ns)  # what ended by now no longer takes a place
            if len(sender.queue) >= self.queue_frames:
                sender.refused += 1
                return False
        self._sequence += 1
        sender.queue.append(_Pending(frame, now_ns, self._sequence, arbitration_key(frame)))
        return True

    def queued(self, node: int) -> int:
        """Frames that wait in the node's transmit queue, the one on the wire included."""
        return len(self._node(node).queue)

    def count_overrun(self, node: int) -> None:
        """The node could not take a frame that was delivered to it."""
        self.overruns += 1
        self._node(node).overruns += 1

    # -- time -----------------------------------------------------------------------------------------------------

    def advance(self, now_ns: int) -> list[Delivery]:
        """The frames that ended up to `now_ns`, in the order of the wire; each is returned once."""
        self._run(now_ns)
        done, self._done = self._done, []
        return done

    def next_event_ns(self) -> int | None:
        """When `advance` will have something, as things stand; None while nobody wants to send.

        A frame submitted meanwhile can change it only if the bus is idle until then.
        """
        if self._done:
            return self._done[0].frame.t_ns
        upcoming = self._upcoming()
        return upcoming[1] if upcoming else None

    def _run(self, now_ns: int) -> None:
        while (upcoming := self._upcoming()) and upcoming[1] <= now_ns:
            self._commit(*upcoming)

    def _upcoming(self) -> tuple[int, int, list[int]] | None:
        """Start, end of frame and senders of the next frame, if nobody else submits anything before its start."""
        heads = [(number, node.queue[0]) for number, node in self._nodes.items() if node.queue]
        if not heads:
            return None
        start_ns = max(self._free_ns, min(head.ready_ns for _, head in heads))
        contenders = [(number, head) for number, head in heads if head.ready_ns <= start_ns]
        _, winner = min(contenders, key=lambda c: (c[1].key, c[1].sequence))
        content = winner.frame.key()
        senders = [number for number, head in contenders if head.key == winner.key and head.frame.key() == content]
        senders.sort(key=lambda number: self._nodes[number].queue[0].sequence)
        return start_ns, start_ns + self._duration_ns(bits_on_wire(winner.frame) - INTERFRAME_BITS), senders

    def _commit(self, start_ns: int, end_ns: int, senders: list[int]) -> None:
        winner = self._nodes[senders[0]].queue[0]
        bits = bits_on_wire(winner.frame)
        self.conflicts += any(
            node.queue[0].key == winner.key and node.queue[0].ready_ns <= start_ns
            for number, node in self._nodes.items()
            if node.queue and number not in senders
        )
        for number in senders:
            self._nodes[number].queue.popleft()
            self._nodes[number].sent += 1
        receivers = []
        for number, node in self._nodes.items():
            if number not in senders and not node.left and node.joined_ns <= start_ns:
                node.received += 1
                receivers.append(number)
        self._free_ns = start_ns + self._duration_ns(bits)
        self._count(winner.frame, bits, end_ns)
        self._done.append(
            Delivery(replace(winner.frame, t_ns=end_ns), start_ns, bits, tuple(senders), tuple(receivers))
        )
        for number in senders:
            self._forget_if_done(number)

    def _duration_ns(self, bits: int) -> int:
        return 0 if self.instant else (bits * NS_PER_S + self.bitrate // 2) // self.bitrate

    # -- counting -------------------------------------------------------------------------------------------------

    def load(self, now_ns: int) -> float:
        """Share of the last second's bits that carried frames, 0 to 1 (more than 1 is possible where frames are instant)."""
        newest = now_ns // _SLOT_NS
        bits = sum(count for slot, count in self._slots if newest - slot < _SLOTS)
        return bits / (self.bitrate * _SLOTS * _SLOT_NS / NS_PER_S)

    def stats(self, now_ns: int) -> dict[str, Any]:
        """Totals, per node and per identifier (as candump writes it); JSON-able.

        ``frames``, ``bits`` (stuffed, with interframe space), ``load`` (0 to 1, last second), ``overruns``, ``conflicts``,
        ``bitrate``, ``by_id`` and ``nodes``: a list of node, name, sent, received, overruns, refused, queued.
        """
        return {
            "bitrate": self.bitrate,
            "frames": self.frames,
            "bits": self.bits,
            "load": self.load(now_ns),
            "overruns": self.overruns,
            "conflicts": self.conflicts,
            "by_id": dict(self._by_id),
            "nodes": [
                {
                    "node": number,
                    "name": node.name,
                    "sent": node.sent,
                    "received": node.received,
                    "overruns": node.overruns,
                    "refused": node.refused,
                    "queued": len(node.queue),
                }
                for number, node in self._nodes.items()
            ],
        }

    def _count(self, frame: CanFrame, bits: int, end_ns: int) -> None:
        self.frames += 1
        self.bits += bits
        name = f"{frame.can_id:08X}" if frame.extended else f"{frame.can_id:03X}"
        self._by_id[name if name in self._by_id or len(self._by_id) < MAX_IDS_COUNTED else "other"] += 1
        slot = end_ns // _SLOT_NS
        if not self._slots or self._slots[-1][0] != slot:
            self._slots.append([slot, 0])
        self._slots[-1][1] += bits

    def _node(self, node: int) -> _Node:
        try:
            return self._nodes[node]
        except KeyError:
            raise Bug("a node that is not on the CAN bus", got=str(node)) from None

    def _forget_if_done(self, node: int) -> None:
        if self._nodes[node].left and not self._nodes[node].queue:
            del self._nodes[node]
