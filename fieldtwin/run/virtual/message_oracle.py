"""The check of mailboxes in virtual time: each command of the remote client arrives at most once, in order and unchanged."""

from __future__ import annotations

from fieldtwin.gateway.core.concurrency.events import Consumer, Producer
from fieldtwin.gateway.core.values import DATA

MOST_KEPT = 100_000
"""Maximum number of messages kept for the comparison. If more arrive, only the newest are checked."""


class MessageOracle:
    """A comparison of the messages that arrived with those that were sent.

    Call `watch`, then `check`; `wrong` lists the differences.

    A command may be lost, because faults may lose it. It may not arrive twice, before an older one, or with different
    bytes.
    """

    def __init__(self) -> None:
        self.wrong: list[str] = []
        self._arrived: Consumer[DATA] | None = None

    def watch(self, emitter: Producer[DATA]) -> None:
        """Record every message that the driver with this `emitter` treats as new."""
        self._arrived = Consumer(emitter.event, MOST_KEPT)
        emitter.subscribe(self._arrived)

    def check(self, sent: list[bytes]) -> None:
        """Compare the messages that arrived with those that were `sent`, both in order of time."""
        arrived = [] if self._arrived is None else [item.data for item in self._arrived.queue]
        left = iter(sent)
        for number, message in enumerate(arrived, start=1):
            if not any(message == one for one in left):
                self.wrong = [
                    f"command {number} that arrived ({message.hex()}) was not sent, or arrived twice or in the wrong order: "
                    f"{len(sent)} were sent, {len(arrived)} arrived"
                ]
                return
