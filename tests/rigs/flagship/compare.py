"""Compare two conversations with the same device field by field. Pure: conversations and rules in, differences out.

Everything must be equal unless a rule (tolerances.yaml) allows a difference and gives the reason. The rules have no key
to allow a request with different bytes, a reply of a different length or function, or a different exception or abort
code.

A conversation consists of *polls* (cyclic reads: their number and position are timing and are ignored; their replies,
with repetitions collapsed, are compared), *streams* (requests that are ordered among themselves only), the *script*
(all other requests, in order), and *heard* frames, which were received without a request.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby, pairwise
from pathlib import Path
from statistics import median
from typing import Any

from conversation import Conversation, Exchange, Heard
from pydantic import BaseModel, ConfigDict

TOLERANCES = Path(__file__).with_name("tolerances.yaml")


class Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Field(Strict):
    """A number in a reply or frame that may differ: `at` bytes from its start, a `struct` format, the tolerance, and
    the reason."""

    name: str
    at: int
    format: str
    within: float
    why: str

    def value(self, data: bytes) -> float:
        return float(struct.unpack_from(self.format, data, self.at)[0])

    def blanked(self, data: bytes) -> bytes:
        end = self.at + struct.calcsize(self.format)
        return data[: self.at] + bytes(end - self.at) + data[end:]


class Spare(Strict):
    """The maximum surplus on one side."""

    most: int = 0
    why: str = ""


class Rule(Strict):
    """A poll or a stream, identified by the first bytes of its requests (hex, from the unit ID or COB-ID on)."""

    request: str
    why: str
    fields: tuple[Field, ...] = ()
    spare: Spare = Spare()
    interval_within_ms: float | None = None

    @property
    def prefix(self) -> bytes:
        return bytes.fromhex(self.request)


class HeardRule(Strict):
    """Frames with one COB-ID. `collapse`: repetitions of a state are ignored; otherwise a series that is compared frame
    by frame."""

    cob_id: str
    why: str
    collapse: bool = False
    fields: tuple[Field, ...] = ()
    interval_within_ms: float | None = None


class DeviceRules(Strict):
    """The permitted differences between two conversations with one device."""

    polls: tuple[Rule, ...] = ()
    streams: tuple[Rule, ...] = ()
    heard: tuple[HeardRule, ...] = ()
    latency_within_ms: float
    latency_why: str


Tolerances = dict[str, DeviceRules]


@dataclass(frozen=True, slots=True)
class Difference:
    """A difference: where (a request in hex, or a COB-ID), what, the expected and the actual value."""

    device: str
    where: str
    what: str
    expected: str
    got: str

    def __str__(self) -> str:
        return f"{self.device}, {self.where}: {self.what}: expected {self.expected}, got {self.got}"


class Comparison:
    """Compare `other` with `reference`; `differences` has the result, `compared` the amount of data compared."""

    def __init__(self, reference: Conversation, other: Conversation, rules: DeviceRules) -> None:
        self.differences: list[Difference] = []
        self.compared = 0
        self._device = reference.device
        for talk, which in ((reference, "the reference"), (other, "the other")):
            for fault in talk.faults:
                self._differ("frames", f"a fault in {which}", "none", fault)
        self._polls(reference, other, rules.polls)
        for stream in rules.streams:
            pair = [[e for e in t.exchanges if e.request.startswith(stream.prefix)] for t in (reference, other)]
            self._sequence(*pair, stream.fields, stream.spare.most)
        apart = tuple(r.prefix for r in (*rules.polls, *rules.streams))
        script = [[e for e in t.exchanges if not e.request.startswith(apart)] for t in (reference, other)]
        self._sequence(*script, (), 0)
        self._heard(reference, other, rules.heard)
        self._close(
            "all exchanges", "median latency in ms", *map(_latency, (reference, other)), rules.latency_within_ms
        )

    def _differ(self, where: str, what: str, expected: str, got: str) -> None:
        found = Difference(self._device, where, what, expected, got)
        if found not in self.differences:
            self.differences.append(found)

    def _close(self, where: str, what: str, expected: float | None, got: float | None, within: float | None) -> None:
        if within is not None and expected is not None and got is not None and abs(expected - got) > within:
            self._differ(where, what, f"{expected:.1f} +- {within:g}", f"{got:.1f}")

    # -- requests and replies -------------------------------------------------------------------------------------------

    def _sequence(self, one: list[Exchange], two: list[Exchange], fields: Sequence[Field], spare: int) -> None:
        """Compare exchanges in order. The first request that differs ends the comparison, because the rest is out of
        step."""
        for a, b in zip(one, two, strict=False):
            self.compared += 1
            if a.request != b.request:
                self._differ(f"request {self.compared}", "request bytes", a.request.hex(" "), b.request.hex(" "))
                return
            for what, expected, got in reply_differences(a.reply, b.reply, fields):
                self._differ(a.request.hex(" "), what, expected, got)
        if abs(len(one) - len(two)) > spare:
            more = (one if len(one) > len(two) else two)[min(len(one), len(two))]
            self._differ(more.request.hex(" "), "number of requests", str(len(one)), str(len(two)))

    def _polls(self, one: Conversation, two: Conversation, rules: Sequence[Rule]) -> None:
        for rule in rules:
            a, b = ([e for e in t.exchanges if e.request.startswith(rule.prefix)] for t in (one, two))
            distinct = [list(dict.fromkeys(e.request for e in side)) for side in (a, b)]
            if len(distinct[0]) != 1 or distinct[0] != distinct[1]:
                names = ["; ".join(r.hex(" ") for r in side) or "never sent" for side in distinct]
                self._differ(rule.request, "poll", *names)
                continue
            self._replies(rule, *([e.reply for e in side] for side in (a, b)))
            where = rule.request
            self._close(where, "median interval in ms", _interval(a), _interval(b), rule.interval_within_ms)

    def _replies(self, rule: Rule, one: list[bytes], two: list[bytes]) -> None:
        """Require that every distinct reply of one side also occurs on the other, except the last one of the longer
        side."""
        a, b = list(dict.fromkeys(one)), list(dict.fromkeys(two))
        self.compared += len(a) + len(b)
        for mine, others, mine_is_reference in ((a, b, True), (b, a, False)):
            must = len(mine) - min(rule.spare.most, max(0, len(mine) - len(others)))
            for i, reply in enumerate(mine):
                near = _nearest(reply, others, rule.fields)
                pair = (reply, near) if mine_is_reference else (near, reply)
                found = reply_differences(*pair, rule.fields) if i < must else list(_structure(*pair))
                for difference in found:
                    self._differ(rule.request, *difference)

    # -- what was heard --------------------------------------------------------------------------------------------------

    def _heard(self, one: Conversation, two: Conversation, rules: Sequence[HeardRule]) -> None:
        known = {int(r.cob_id, 16): r for r in rules}
        for cob_id in sorted({h.cob_id for t in (one, two) for h in t.heard}):
            a, b = ([h for h in t.heard if h.cob_id == cob_id] for t in (one, two))
            where, rule = f"{cob_id:03X}h", known.get(cob_id)
            if rule is None or not a or not b:
                self._differ(where, "frames", f"{len(a)}", f"{len(b)}{'' if rule else ' (no rule says what they are)'}")
                continue
            series = [
                [d for d, _ in groupby(h.data for h in s)] if rule.collapse else [h.data for h in s] for s in (a, b)
            ]
            if rule.collapse and len(series[0]) != len(series[1]):
                self._differ(where, "states", *(" ".join(d.hex() for d in s) for s in series))
            for expected_data, got_data in zip(*series, strict=False):
                self.compared += 1
                for what, expected, got in frame_differences(expected_data, got_data, rule.fields):
                    self._differ(where, what, expected, got)
            self._close(where, "median interval in ms", _interval(a), _interval(b), rule.interval_within_ms)


def compare(reference: Conversation, other: Conversation, rules: DeviceRules) -> list[Difference]:
    """Return the differences in order; empty if there are none."""
    return Comparison(reference, other, rules).differences


def reply_differences(expected: bytes, got: bytes, fields: Iterable[Field]) -> list[tuple[str, str, str]]:
    """Return the kind, expected and actual value of each difference of two replies."""
    return list(_structure(expected, got)) or frame_differences(expected, got, fields)


def frame_differences(expected: bytes, got: bytes, fields: Iterable[Field]) -> list[tuple[str, str, str]]:
    """As `reply_differences`, for bytes of which only the fields are known."""
    if len(expected) != len(got):
        return [("length", f"{len(expected)} bytes", f"{len(got)} bytes")]
    found = []
    for f in fields:
        a, b = f.value(expected), f.value(got)
        if not (abs(a - b) <= f.within):
            found.append((f.name, f"{a:g} +- {f.within:g}", f"{b:g}"))
        expected, got = f.blanked(expected), f.blanked(got)
    if expected != got:
        found.append(("bytes", expected.hex(" "), got.hex(" ")))
    return found


def _structure(expected: bytes, got: bytes) -> Iterator[tuple[str, str, str]]:
    """Return whether there is a reply of the same function and length, with the same code if it is an error."""
    if expected == got:
        return
    if not expected or not got:
        yield "reply", expected.hex(" ") or "none", got.hex(" ") or "none"
    elif _refusal(expected) != _refusal(got):
        yield "refusal", _refusal(expected) or "none", _refusal(got) or "none"
    elif len(expected) != len(got):
        yield "length", f"{len(expected)} bytes", f"{len(got)} bytes"
    elif expected[:2] != got[:2]:
        yield "address and function", expected[:2].hex(" "), got[:2].hex(" ")


def _is_sdo(reply: bytes) -> bool:
    """Return whether it is COB-ID 581h to 5FFh with eight bytes."""
    return len(reply) == 10 and 0x581 <= int.from_bytes(reply[:2]) <= 0x5FF


def _refusal(reply: bytes) -> str:
    """Return the exception code of a Modbus reply (AP 7) or the abort code of an SDO (CiA 301, 7.2.4.3.17); "" if
    neither."""
    if _is_sdo(reply):
        return f"abort {int.from_bytes(reply[6:10], 'little'):08X}h" if reply[2] == 0x80 else ""
    return f"exception {reply[2]:02X}h" if len(reply) >= 3 and reply[1] & 0x80 else ""


def _nearest(reply: bytes, others: Sequence[bytes], fields: Sequence[Field]) -> bytes:
    """Return the reply of `others` that differs least from `reply`."""
    return min(others, key=lambda o: (len(reply_differences(o, reply, fields)), _bytes_apart(o, reply)), default=b"")


def _bytes_apart(a: bytes, b: bytes) -> int:
    return abs(len(a) - len(b)) + sum(x != y for x, y in zip(a, b, strict=False))


def _latency(talk: Conversation) -> float | None:
    return median(times) if (times := [e.latency_ms for e in talk.exchanges if e.reply]) else None


def _interval(items: Sequence[Exchange] | Sequence[Heard]) -> float | None:
    """Return the median interval in ms."""
    gaps = [(b.t_ns - a.t_ns) / 1e6 for a, b in pairwise(items)]
    return median(gaps) if gaps else None


def load_tolerances(text: dict[str, Any]) -> Tolerances:
    """Return the checked content of the reviewed file. A misspelt key is an error, not a missing rule."""
    return {device: DeviceRules.model_validate(rules) for device, rules in text.items()}
