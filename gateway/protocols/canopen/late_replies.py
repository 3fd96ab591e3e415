"""Which replies may still be on their way after an SDO request went unanswered, and how to get past them.

An SDO reply names index and subindex, no request. When a request timed out and the same object is asked for again,
a late reply to the first would pass for a reply to the second: an old value, delivered as a new one. Waiting "long
enough" only makes that rarer. What settles it is order: a server handles one request at a time on a channel and its
replies share one CAN-ID, so they come in the order of the requests. A reply to a *later* request for *another* object
therefore proves that nothing before it can still come. So:

- A request for an object that nothing is outstanding for goes out at once: its multiplexor tells its reply from every
  late one, and that reply, when it comes, settles all that was outstanding before.
- A request for an object with a reply outstanding is preceded by a probe: a read of a mandatory object that none is
  outstanding for. A reply to it (an abort will do) settles the rest. A dead node so costs one time-out a request, as
  before, and a boot-up settles everything.

Pure; knows no frame and no time.
"""

from __future__ import annotations

from collections import deque

Multiplexor = tuple[int, int]
"""Index and subindex."""

MAX_OUTSTANDING = 64
"""A reply that is late by more than so many unanswered requests is held impossible."""

PROBES: tuple[Multiplexor, ...] = ((0x1000, 0), (0x1001, 0), (0x1018, 0), (0x1018, 1))
"""Objects that every node must have (7.5.2.1, 7.5.2.2, 7.5.2.19), read without effect."""


class LateReplies:
    """The unanswered requests of one node, oldest first."""

    def __init__(self) -> None:
        self._outstanding: deque[Multiplexor] = deque(maxlen=MAX_OUTSTANDING)

    def unanswered(self, request: Multiplexor) -> None:
        """A request was given up on (time-out, cancellation, protocol error): its reply may come later, or never."""
        self._outstanding.append(request)

    def answered(self, request: Multiplexor) -> bool:
        """A reply for `request` came. If one was outstanding for it, this may be that one: only what is older is settled, and
        it is True: who asked for it now has to go on expecting the other reply."""
        while self._outstanding:
            if self._outstanding.popleft() == request:
                return True
        return False

    def settle(self) -> None:
        """Nothing can be on its way any more: the node has booted."""
        self._outstanding.clear()

    def is_ambiguous(self, request: Multiplexor) -> bool:
        """Whether a late reply could pass for the reply to `request`."""
        return request in self._outstanding

    def probe(self) -> Multiplexor:
        """What to read to settle things: nothing outstanding for it, or, for a node long dead, the longest ago."""
        for candidate in PROBES:
            if candidate not in self._outstanding:
                return candidate
        last = list(self._outstanding)
        return min(PROBES, key=lambda candidate: max(i for i, request in enumerate(last) if request == candidate))
