"""The variables of the PLC for servers: the values that the PLC publishes, and the writes of clients to located variables.

A write is a message in the process image, which the program that offers the variable takes at the start of its next scan. So
the values of one request take effect together, and the client gets the answer after the scan that used them.
"""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

from fieldtwin.gateway.core.clock import NS_PER_S, Clock
from fieldtwin.gateway.core.concurrency.events import Consumer
from fieldtwin.gateway.core.errors import EndpointBusy, FieldtwinError, NotAllowed, Unreachable
from fieldtwin.gateway.core.image.image import TagSpec, consumed_name, message_tag
from fieldtwin.gateway.core.values import DATA, NEVER, Quality, Reason, TagValue
from fieldtwin.gateway.runtime.image_io import ImageExchange

WRITES = "st_writes"
"""The message input of a program that takes the writes of clients. No variable of a program has such a name."""
MAX_WRITE_BYTES = 32_768
"""The largest size of the writes of one request to one program, as JSON."""
MAX_WRITES = 4
"""The number of requests to one program that may wait for its next scan."""
TIMEOUT_NS = 2 * NS_PER_S
"""A client gets an error if the program has not taken a write after this time, for example because it is paused."""


def writes_tag(program: str) -> TagSpec:
    """Return the tag of the message input through which a program takes the writes of clients."""
    return message_tag(f"{program}.{WRITES}", MAX_WRITE_BYTES, MAX_WRITES)


def is_of_writes(tag: str) -> bool:
    """Return whether a tag belongs to the message input for writes, so that users do not see it."""
    return tag.endswith((f".{WRITES}", consumed_name(f".{WRITES}")))


@dataclass(frozen=True, slots=True)
class _Pending:
    """A write that a program has not taken yet: its tag, its number among the messages of the tag, and its deadline."""

    tag: str
    number: int
    deadline_ns: int
    done: Callable[[FieldtwinError | None], None]


class PlcVariables:
    """The published variables of the PLC, and the writes to those of `programs`. `exchange` is set before the first call."""

    exchange: ImageExchange

    def __init__(self, programs: Iterable[str], clock: Clock) -> None:
        self.sources: dict[str, Consumer[DATA]] = {
            writes_tag(program).name: Consumer("writes", capacity=MAX_WRITES) for program in programs
        }
        """The queues of messages for the exchange, by tag."""
        self.alive = False
        """Whether the PLC runs; otherwise its variables are bad, and writes are refused."""
        self._clock = clock
        self._pending: deque[_Pending] = deque()

    def current(self, tag: str) -> TagValue:
        """Return the value of a tag that the PLC publishes. It is bad while the PLC does not run."""
        value = self.exchange.outputs.get(tag, NEVER)
        return value if self.alive else TagValue(value.value, Quality.BAD, Reason.NOT_OPERATIONAL, value.t_ns)

    def request(self, values: Mapping[str, Mapping[str, float]], done: Callable[[FieldtwinError | None], None]) -> None:
        """Write variables, given by program and name. `done` is called after the last program has taken its values, or with an
        error. After a timeout, a program may still take the values later.
        """
        if not self.alive:
            done(Unreachable("the PLC does not run"))
            return
        tags = {
            writes_tag(program).name: json.dumps(written, separators=(",", ":")).encode()
            for program, written in values.items()
        }
        if any(len(data) > MAX_WRITE_BYTES for data in tags.values()):
            done(
                NotAllowed(
                    "too many variables in one write", expected=f"at most {MAX_WRITE_BYTES} bytes of names and values"
                )
            )
            return
        if any(len(self.sources[tag].queue) >= MAX_WRITES for tag in tags):
            done(EndpointBusy("too many writes wait for the next scan", where=", ".join(values)))
            return
        left = len(tags)

        def one_done(error: FieldtwinError | None) -> None:
            nonlocal left
            left -= 1
            if error is not None or left == 0:
                done(error)

        deadline_ns = self._clock.monotonic_ns() + TIMEOUT_NS
        for tag, data in tags.items():
            queue = self.sources[tag].queue
            queue.append(DATA(data))
            number = self.exchange.last_published(tag) + len(queue)
            self._pending.append(_Pending(tag, number, deadline_ns, one_done))

    def tick(self, now_ns: int) -> None:
        """Complete the writes that programs have taken, and those that have waited too long."""
        for _ in range(len(self._pending)):
            one = self._pending.popleft()
            if self.exchange.consumed(one.tag) >= one.number:
                one.done(None)
            elif now_ns > one.deadline_ns:
                one.done(Unreachable("the program has not taken the write", where=one.tag))
            else:
                self._pending.append(one)

    @property
    def is_idle(self) -> bool:
        return not self._pending
