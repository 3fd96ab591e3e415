"""Track which replies may still arrive after an SDO request was not answered, and prevent their use for a different request.

An SDO reply names index and subindex, but not the request. If a request timed out and the same object is requested
again, a late reply to the first request could be taken for a reply to the second: an old value would be delivered as a
new one. Waiting "long enough" only makes that rarer. The order of replies solves it: a server handles one request at a
time on a channel and its replies share one CAN-ID, so they arrive in the order of the requests. A reply to a *later*
request for a *different* object therefore proves that no reply to an earlier request can still arrive. So:

- A request for an object without an outstanding reply is sent immediately: its multiplexor distinguishes its reply
  from every late one. When that reply arrives, it settles all earlier requests: they need no longer be tracked.
- A request for an object with an outstanding reply is preceded by a probe: a read of a mandatory object without an
  outstanding reply. A reply to the probe (an abort is enough) settles the earlier requests.

So a node that does not answer still costs only one timeout per request. A boot-up message settles all requests. This module
handles index and subindex only; frames and times are handled by `channel`.
"""

from __future__ import annotations

from collections import deque

Multiplexor = tuple[int, int]
"""Index and subindex."""

MAX_OUTSTANDING = 64
"""The largest number of unanswered requests that are tracked. A reply to an older request is considered impossible."""

PROBES: tuple[Multiplexor, ...] = ((0x1000, 0), (0x1001, 0), (0x1018, 0), (0x1018, 1))
"""Objects that every node must have (7.5.2.1, 7.5.2.2, 7.5.2.19), and that can be read without an effect."""


class LateReplies:
    """The unanswered requests of one node, oldest first."""

    def __init__(self) -> None:
        self._outstanding: deque[Multiplexor] = deque(maxlen=MAX_OUTSTANDING)

    def unanswered(self, request: Multiplexor) -> None:
        """Note that a request was given up (timeout, cancellation, protocol error). Its reply may still arrive."""
        self._outstanding.append(request)

    def answered(self, request: Multiplexor) -> bool:
        """Note that a reply for `request` arrived, and return whether one more reply for it may still arrive.

        If an earlier request for the same object is unanswered, the reply may belong to that request. Then only older requests
        are settled, the result is True, and the caller has to expect one more reply.
        """
        while self._outstanding:
            if self._outstanding.popleft() == request:
                return True
        return False

    def settle(self) -> None:
        """Forget all requests because the node has booted: no reply can arrive any more."""
        self._outstanding.clear()

    def is_ambiguous(self, request: Multiplexor) -> bool:
        """Return whether a late reply could be taken for the reply to `request`."""
        return request in self._outstanding

    def probe(self) -> Multiplexor:
        """Return the object for the probe: an object without an outstanding reply, or else the one that was requested longest
        ago.
        """
        for candidate in PROBES:
            if candidate not in self._outstanding:
                return candidate
        last = list(self._outstanding)
        return min(PROBES, key=lambda candidate: max(i for i, request in enumerate(last) if request == candidate))
