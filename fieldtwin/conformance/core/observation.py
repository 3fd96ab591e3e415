"""The observations of a case about the client under test: frames, times, and the published values.

Checks receive only an `Observation`, so that they can be tested without a connection.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import Enum
from typing import TypeVar

from fieldtwin.gateway.core.clock import NS_PER_S


@dataclass(frozen=True, slots=True)
class RequestSeen:
    """A whole request of the client.

    Requests with an equal `target` are repetitions of each other (Modbus: unit ID and PDU; SDO: node ID and the eight
    bytes). `tag` is the transaction ID, 0 where there is none. `frame` is the whole frame, in hex or in candump format.
    """

    t_ns: int
    client: int
    target: bytes
    tag: int = 0
    frame: str = ""


@dataclass(frozen=True, slots=True)
class ReplySent:
    """A reply of the device; `good` if it was a true answer in a correct frame.

    `asked_ns` is the time of the request that it answers, 0 where that is not known. `frame` is a CAN frame in candump
    format.
    """

    t_ns: int
    client: int
    data: bytes
    good: bool
    asked_ns: int = 0
    frame: str = ""


@dataclass(frozen=True, slots=True)
class Sent:
    """A frame of the client that expects no answer: NMT, SYNC, a PDO, an SDO abort.

    `data` is the CAN identifier in two bytes (big-endian), followed by the data bytes of the frame.
    """

    t_ns: int
    client: int
    data: bytes


@dataclass(frozen=True, slots=True)
class Garbled:
    """Bytes of the client that do not form a request."""

    t_ns: int
    client: int
    data: bytes


@dataclass(frozen=True, slots=True)
class ObservedConnection:
    """A connection of the client, numbered from 1. A serial line and a bus have one connection, which always exists.
    `by_us`: the test case removed the port and restored it, so the client did not cause the new connection.
    """

    t_ns: int
    client: int
    by_us: bool = False


@dataclass(frozen=True, slots=True)
class Left:
    """The end of a connection; `by_us` if the case closed it."""

    t_ns: int
    client: int
    by_us: bool = False


class Word(Enum):
    """The kind of a published value. FIRST and SECOND are the two values of correct answers."""

    FIRST = "first"
    SECOND = "second"
    POISON = "poison"
    OTHER = "other"
    NONE = "none"
    """No value, or a value that means "no value": bad quality, or not a number."""
    UNCLEAR = "unclear"
    """A number that the probe cannot distinguish from a published value."""


@dataclass(frozen=True, slots=True)
class ValuePublished:
    """A value that the client publishes, as the probe reports it. `text` is the text that was read."""

    t_ns: int
    word: Word
    text: str = ""


@dataclass(frozen=True, slots=True)
class Ended:
    """The unexpected end of the program under test. `status` is its exit code."""

    t_ns: int
    status: int


Event = RequestSeen | ReplySent | Sent | Garbled | ObservedConnection | Left | ValuePublished | Ended
E = TypeVar("E", RequestSeen, ReplySent, Sent, Garbled, ObservedConnection, Left, ValuePublished, Ended)


@dataclass(frozen=True, slots=True)
class Habit:
    """The polling behaviour of the client without faults; times are in seconds.

    `period_s` maps each shape of request to the usual time between two such requests. `longest_gap_s` is the longest time
    between any two requests. `silent_gap_s` is the time from an unanswered request to the next request, 0 if it was not
    measured. `rate_per_s` is the number of requests per second.
    """

    period_s: dict[bytes, float] = field(default_factory=dict)
    longest_gap_s: float = 1.0
    silent_gap_s: float = 0.0
    rate_per_s: float = 1.0


@dataclass(frozen=True)
class Observation:
    """All that was observed in one test case. Times are in nanoseconds on the clock of the simulated device.

    `begun_ns`: the first request that received a wrong reply; `over_ns`: the end of the device's last fault, after which it
    replied correctly; `until_ns`: the end of the observation. `before` is the word that was held before, `after` the one
    from `begun_ns` on, also in faulty frames if the client is to accept them, `last` the one from `over_ns` on.
    `timeout_s`: the client's response timeout as stated by the user, 0 if not stated.
    """

    events: tuple[Event, ...]
    begun_ns: int
    over_ns: int
    until_ns: int
    habit: Habit = field(default_factory=Habit)
    before: Word = Word.FIRST
    after: Word = Word.SECOND
    last: Word = Word.SECOND
    probed: bool = False
    timeout_s: float = 0.0
    patience_s: float = 10.0

    def of(self, kind: type[E], since_ns: int = 0, until_ns: int | None = None) -> Iterator[E]:
        """Yield the events of a kind in a time window, both ends included, in order."""
        for event in self.events:
            if isinstance(event, kind) and since_ns <= event.t_ns and (until_ns is None or event.t_ns <= until_ns):
                yield event

    def since_s(self, t_ns: int) -> float:
        """Return the seconds from the first wrong reply to `t_ns`."""
        return (t_ns - self.begun_ns) / NS_PER_S
