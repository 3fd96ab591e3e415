"""Models of mailboxes: any number of messages up to a limit, with any content and time, and room for any number of new ones.

The content of a message is a text that is not known. So a proof holds for every sequence of messages, and a counterexample counts
only if the compiled program does the same with messages that are empty.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

from fieldtwin.plc.st.model_checking.execution import operations
from fieldtwin.plc.st.model_checking.execution.symbolic import TEXT, UNDEFINED, Condition, either

MOST_MESSAGES = 16
"""The largest number of messages that a mailbox brings in one scan of the model. It is an assumption of each proof."""
LATEST_NS = 2**62 - 1
"""The latest time of the clock, 146 years after its start."""


class Evaluation(Protocol):
    """The part of the evaluation that these models use."""

    def fail_if(self, condition: Condition, message: str) -> None: ...

    def unknown_condition(self, what: str) -> Condition: ...

    def unknown_integer(self, what: str, low: int, high: int) -> Any: ...


def modelled(function: Callable[..., Any]) -> Callable[..., Any]:
    """Mark a method as a model: it is called with the evaluation before its arguments, and not executed symbolically."""
    function.modelled = True  # type: ignore[attr-defined]
    return function


class Model:
    """An object that stands for one of the running PLC. It has no state."""


@dataclass(frozen=True, slots=True)
class Content(Model):
    """The bytes of a message."""

    @modelled
    def decode(self, x: Evaluation, encoding: str) -> Any:
        return TEXT


@dataclass(frozen=True, slots=True)
class ReceivedMessage(Model):
    """A message that the program received. Its time is that of its source, by any clock."""

    t_ns: Any
    data: Content = Content()


@dataclass(frozen=True, slots=True)
class Mailbox(Model):
    """The messages that are new in a scan: a `count` that is symbolic."""

    count: Any

    def message(self, x: Evaluation, number: Any, *, timed: bool) -> Any:
        """Return the message `number`, which counts from 1. `timed`: the program reads times of messages."""
        outside = either(operations.compare("<", number, 1), operations.compare(">", number, self.count))
        x.fail_if(outside, "an index outside its array")
        if outside is True:
            return UNDEFINED
        time = x.unknown_integer("MSG_TIME", -(2**63), 2**63 - 1) if timed else UNDEFINED
        return ReceivedMessage(time)


@dataclass(frozen=True, slots=True)
class Outgoing(Model):
    """A message output. The receiver takes messages at any time, so each one may find room or not."""

    max_bytes: int
    depth: int

    @modelled
    def room_left(self, x: Evaluation) -> Any:
        return x.unknown_integer("MSG_ROOM", 0, self.depth)

    @modelled
    def send(self, x: Evaluation, data: Any, t_ns: Any) -> Any:
        if isinstance(data, bytes):
            x.fail_if(len(data) > self.max_bytes, "message too long")
        else:
            x.fail_if(x.unknown_condition("the length of a message"), "message too long")
        return x.unknown_condition("MSG_SEND")
