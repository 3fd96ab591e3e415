"""The proof of the observatory's relay: the paper's ControlLogic, with rulings 1, 2, 5 and 6 of paper.md.

It covers commands of every sign (-1, 0, 1 and the limits of the type; only the sign matters), invalid commands, scans with and
without a response, and mailboxes that are emptied or not. The queue and the data log are limited to three entries, so that all
their fill levels are reached.
"""

from __future__ import annotations

from collections.abc import Hashable

from fieldtwin.gateway.core.statemachine import STATE_CODES, delta, encode_period
from fieldtwin.plc.program import ScanInfo
from fieldtwin.plc.prove import Proof
from fieldtwin.plc.relay import DataLog, Relay

_DEPTH = 2
_LOG_CAPACITY = 3
_SHORT, _TOO_LONG = b"a", b"b" * 300


class RelayWithHistory(Relay):
    """The relay, with the history that the invariants need."""

    queue_capacity = 3

    def __init__(self) -> None:
        super().__init__()
        self.response.depth = self.log.depth = _DEPTH
        self.logic.data_log = DataLog(_LOG_CAPACITY)
        self.sent = 0
        self.logged_before = 0

    def execute(self, scan: ScanInfo) -> None:
        self.logged_before = self.logged
        super().execute(scan)
        self.sent += len(self.response.pending)

    @property
    def unaccounted(self) -> int:
        """Return the number of received responses that are neither sent, nor waiting, nor counted as dropped or as too long."""
        return self.responses - self.sent - self.waiting - self._outgoing.dropped - self._too_long

    @property
    def key(self) -> Hashable:
        """Return the part of the state that matters: the sign, and the fill levels of queues and mailboxes.

        Counters grow without limit and do not affect the behaviour."""
        sign = (self.period_s > 0) - (self.period_s < 0)
        waiting = tuple(response.data for response in self._outgoing.queue)
        unsent = self.logic.data_log.total - self._log_sent
        boxes = tuple((box.outstanding, len(box.pending)) for box in (self.response, self.log))
        return sign, self.state, waiting, unsent, boxes


PROOF = Proof(
    make=RelayWithHistory,
    domain={
        "command": [None, *(encode_period(p).data for p in (-32768, -1, 0, 1, 32767)), b"", b"\1\2\3"],
        "sample": [None, _SHORT, _TOO_LONG],
    },
    clogs=True,
    key=lambda relay: relay.key,
    invariants={
        "the state follows from the sign of the period": lambda r: r.state == STATE_CODES[delta(r.period_s).name],
        "the commanded period of the sensor is the period of the relay": lambda r: (
            r.period == r.period_s == r.logic.period_s
        ),
        "nothing is logged while the period is 0 or below": lambda r: r.period_s > 0 or r.logged == r.logged_before,
        "every response leaves, waits or is counted as dropped": lambda r: r.unaccounted == 0,
        "responses leave unaltered": lambda r: all(data == _SHORT for _, data in r.response.pending),
        "no mailbox is overrun": lambda r: all(
            box.outstanding + len(box.pending) <= box.depth for box in (r.response, r.log)
        ),
        "the queue is bounded": lambda r: r.waiting <= r.queue_capacity,
    },
)
