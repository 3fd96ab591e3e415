"""The history of a run from its trace or capture: tags, states and qualities over time, response times, inputs.

Runs of different versions are compared by their histories, because bytes and exact times may differ between equal runs. This
module performs no I/O: it converts events to a `RunHistory`. The number of changes of a field is limited; further changes are
counted.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

from fieldtwin.capture.decoding.decoder import Decoder
from fieldtwin.capture.decoding.exchange import DecodedExchange
from fieldtwin.gateway.core.statemachine import encode_period
from fieldtwin.results.trace import TOPSIDE, TraceEvent, TraceKind
from fieldtwin.twin.site.system import System

MOST = 200_000
"""Maximum number of recorded changes per field."""
SELDOM = 5


@dataclass(frozen=True, slots=True)
class ValueChange:
    """A change: from `t_ns` on, the field had `value` and `quality` ("" for a state, and for a value seen only on a bus)."""

    t_ns: int
    value: Any
    quality: str = ""

    def says(self) -> tuple[Any, str]:
        """Return the part of a change that is compared: its value, or no value if the quality is bad."""
        return (None if self.quality == "bad" else self.value), self.quality

    def __str__(self) -> str:
        value, quality = self.says()
        shown = f"{value:g}" if isinstance(value, float) else str(value)
        return shown if quality in ("", "good") else quality if value is None else f"{shown} ({quality})"


@dataclass(frozen=True, slots=True)
class RemoteCommand:
    """A command of the remote client of `device`: its payload as sent, or as received if the sending was not recorded."""

    t_ns: int
    device: str
    payload: bytes


@dataclass
class RunHistory:
    """The history of a run.

    `tags` and `states` are the changes by DEVICE.TAG and PROGRAM.VARIABLE; `latency_ns` holds the response times by (device,
    service), `problems` the numbers of failures by (device, service, problem); `faults` are the events of faults.
    """

    end_ns: int = 0
    tags: dict[str, list[ValueChange]] = field(default_factory=dict)
    states: dict[str, list[ValueChange]] = field(default_factory=dict)
    latency_ns: dict[tuple[str, str], list[int]] = field(default_factory=lambda: defaultdict(list))
    asked: Counter[tuple[str, str]] = field(default_factory=Counter)
    problems: Counter[tuple[str, str, str]] = field(default_factory=Counter)
    commands: list[RemoteCommand] = field(default_factory=list)
    faults: list[TraceEvent] = field(default_factory=list)
    published: Counter[str] = field(default_factory=Counter)
    """How often each tag was published, changed or not."""
    left_out: int = 0

    def pace_ns(self, name: str) -> int:
        """Return the longest time from a tag's change to its next publication: one and a half of its usual interval.

        0 for a state, and for a tag that is rarely read.
        """
        times = self.published[name]
        return self.end_ns * 3 // (2 * times) if times >= SELDOM else 0

    def note(self, into: dict[str, list[ValueChange]], name: str, change: ValueChange) -> None:
        """Add `change` to the changes of `name`, unless the value is the same as before."""
        changes = into.setdefault(name, [])
        if changes and changes[-1].says() == change.says():
            return
        if len(changes) >= MOST:
            self.left_out += 1
        else:
            changes.append(change)


def run_history(system: System, events: Iterable[TraceEvent]) -> RunHistory:
    """Return the history of events in their order. For a capture, which has only frames, tag values are taken from replies."""
    history, decoder = RunHistory(), Decoder(system)
    answered: list[tuple[str, ValueChange]] = []
    sent: list[RemoteCommand] = []
    boxes: dict[str, tuple[int, ...]] = {}

    def take(exchanges: Iterable[DecodedExchange]) -> None:
        for exchange in exchanges:
            _count(history, exchange)
            _mailbox(history, system, boxes, exchange)
            if exchange.ok and len(answered) < MOST and not exchange.secrets:
                answered.extend(
                    (f"{exchange.device}.{tag}", ValueChange(exchange.end_ns, value))
                    for tag, value in exchange.tags.items()
                    if value is not None and _is_measured(system, exchange, tag)
                )

    for event in events:
        history.end_ns = max(history.end_ns, event.t_ns)
        if event.kind is TraceKind.FRAME:
            take(decoder.feed(event))
        elif event.kind is TraceKind.TAG:
            change = ValueChange(event.t_ns, event.data.get("value"), str(event.data.get("quality", "")))
            history.note(history.tags, event.where, change)
            history.published[event.where] += 1
        elif event.kind is TraceKind.STATE:
            history.note(history.states, event.where, ValueChange(event.t_ns, event.data.get("value")))
        elif event.kind is TraceKind.FAULT:
            history.faults.append(event)
        elif event.kind is TraceKind.NOTE and event.where == TOPSIDE and isinstance(event.data.get("period_s"), int):
            sent.append(RemoteCommand(event.t_ns, event.where, encode_period(event.data["period_s"]).data))
    take(decoder.finish())
    history.commands = sent or history.commands
    if not history.tags:
        for name, change in answered:
            history.note(history.tags, name, change)
            history.published[name] += 1
    return history


def _is_measured(system: System, exchange: DecodedExchange, tag: str) -> bool:
    """Return whether the exchange carries a measured value of `tag`: not a message, and not a reply without a sample."""
    config = system.devices.get(exchange.device)
    if config is None or tag not in config.profile.tags:
        return False
    sampled = config.profile.sampled
    return sampled is None or exchange.tags.get(sampled.count) != 0


def _count(history: RunHistory, exchange: DecodedExchange) -> None:
    key = exchange.device or f"{exchange.bus}/{exchange.unit}", exchange.service
    history.asked[key] += 1
    if exchange.problem:
        history.problems[(*key, exchange.problem)] += 1
    elif exchange.latency_ns is not None:
        history.latency_ns[key].append(exchange.latency_ns)


def _mailbox(history: RunHistory, system: System, boxes: dict[str, tuple[int, ...]], exchange: DecodedExchange) -> None:
    """Add the command in a reply that reads an inbox: sequence number, length in bytes, payload with two bytes per register.

    A repeated sequence number is the same command, and is not added again.
    """
    config = system.devices.get(exchange.device)
    box = config.profile.inbox if config is not None else None
    if box is None or not exchange.ok or not exchange.reads() or len(exchange.registers) < 2:
        return
    if exchange.spans[0].table != box.at.table or exchange.address != box.at.address:
        return
    number, length = exchange.registers[:2]
    payload = b"".join(word.to_bytes(2, "big") for word in exchange.registers[2:])[:length]
    seen = boxes.setdefault(exchange.device, ())
    if number == 0 or (seen and seen[-1] == number) or len(payload) < length:
        return
    boxes[exchange.device] = (number,)
    history.commands.append(RemoteCommand(exchange.t_ns, exchange.device, payload))
