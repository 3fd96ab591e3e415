"""Find the units that answer on one connection: one short request to each, one after the other. The module has no I/O and no
clock.

Unlike the gateway's client, a sweep does not wait after a missing reply. Every reply contains its unit ID, so a late reply is
still attributed to the correct unit. So 247 silent units take 247 timeouts and not twice that. A request with a damaged reply
is repeated once, at the end.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

from fieldtwin.capture.decoding.modbus_frames import ModbusFrame, splitter
from fieldtwin.gateway.core.clock import NS_PER_MS
from fieldtwin.gateway.protocols.modbus.frames.selection import Framing, make_framer
from fieldtwin.gateway.protocols.modbus.requests.data import ReadRegisters
from fieldtwin.gateway.protocols.modbus.requests.request import Request

PROBE = ReadRegisters("holding", 0, 1)
"""The request of a sweep: it reads a register that most devices have.

A device without it answers with an exception, which shows that it is present.
"""

NOBODY = (0x0A, 0x0B)
"""Exceptions by which a gateway reports that it cannot reach the unit or gets no answer from it (AP 7)."""

REST_NS = 30 * NS_PER_MS
"""Time in ns that a sweep waits for the rest of a reply that has begun: a USB adapter delivers bytes every 16 ms."""
MAX_REPLY_CHARS = 256
MAX_REMEMBERED = 256
NEVER_SILENT_NS = 5_000 * NS_PER_MS


@dataclass(frozen=True, slots=True)
class UnitAnswer:
    """The answer of a unit. `exception` is its exception code, 0 for an answer with data; `reply` is the PDU."""

    unit: int
    reply: bytes
    exception: int
    latency_ns: int
    late: bool = False
    """Whether the reply came after the timeout, which is then too short for this unit."""


@dataclass(frozen=True, slots=True)
class SendRequest:
    """A step of a sweep: write `data`, which is the request to `unit`, now; then call `UnitSweep.handed_over`."""

    unit: int
    data: bytes


@dataclass(frozen=True, slots=True)
class WaitForBytes:
    """A step of a sweep: wait until `until_ns`, or until bytes arrive."""

    until_ns: int


@dataclass(slots=True)
class _Asked:
    unit: int
    sent: bytes
    began_ns: int
    deadline_ns: int
    limit_ns: int
    noise: bool = False
    odd: bytes = b""
    """The PDU of a whole reply that does not fit the request; empty if there was none."""


def expected_s(
    units: int, request_chars: int, *, char_time_s: float, timeout_s: float, interval_s: float = 0.0
) -> float:
    """Return the time in seconds that a sweep takes for `units` silent units."""
    return units * max(request_chars * char_time_s + timeout_s, interval_s)


class UnitSweep:
    """A sweep over `units` in order.

    `interval_ns` is the least time between two requests (the rate limit), `quiet_ns` the silence before each, `char_time_ns` the
    time of a character on a serial line, else 0. The caller runs the sweep with `poll`, `handed_over` and `feed`; `found`,
    `damaged` and the other results can be read at any time.
    """

    def __init__(
        self,
        framing: Framing,
        units: Iterable[int],
        *,
        timeout_ns: int,
        char_time_ns: int = 0,
        interval_ns: int = 0,
        quiet_ns: int = 0,
        probe: Request[Any] = PROBE,
    ) -> None:
        self.found: dict[int, UnitAnswer] = {}
        self.damaged: dict[int, bytes] = {}
        """Units that twice gave a reply that does not match the request, with its PDU; empty if it was not a whole frame."""
        self.behind_gateway: set[int] = set()
        """Units that a gateway reported as not answering."""
        self.echo = False
        """Whether the line returns the sent bytes (an echo)."""
        self.foreign = 0
        """Number of good frames that do not belong to the sweep: those of another client and of the units that answer it."""
        self.other_requests = 0
        """Number of good requests that another client sent."""
        self.noise_bytes = 0
        self.never_silent = False
        self.asked = 0
        self._framing: Framing = framing
        self._probe = probe
        self._reply_bytes = probe.nominal_length()
        self._line = framing in ("rtu", "ascii")
        self._framer = make_framer(framing, char_time_ns=char_time_ns, echo=False, strict=False, accepts_zero_id=False)
        self._splitter = splitter(framing)
        self._char_ns = char_time_ns
        self._timeout_ns, self._interval_ns = timeout_ns, interval_ns
        self._quiet_ns = max(quiet_ns, self._framer.t35_ns)
        self._todo = deque(dict.fromkeys(units))
        self._again: deque[int] = deque()
        self._second_round = False
        self._now: _Asked | None = None
        self._past: dict[int, int] = {}
        self._ids: dict[int, int] = {}
        self._not_before_ns = 0
        self._silence_wanted_ns: int | None = None

    @property
    def left(self) -> int:
        """Return the number of remaining requests, including the current one."""
        return len(self._todo) + len(self._again) + (self._now is not None)

    @property
    def asking(self) -> int | None:
        """Return the unit to which the current request was sent; None if no request is open."""
        return self._now.unit if self._now is not None else None

    def poll(self, now_ns: int) -> SendRequest | WaitForBytes | None:
        """Return the next step; None when the sweep is complete or the line is never silent."""
        if self._now is not None:
            if now_ns < self._now.deadline_ns:
                return WaitForBytes(self._now.deadline_ns)
            self._give_up(now_ns)
        if now_ns < self._not_before_ns:
            return self._await_silence(now_ns)
        self._silence_wanted_ns = None
        if not self._todo and self._again:
            self._todo, self._again, self._second_round = self._again, deque(), True
        if not self._todo or self.never_silent:
            return None
        unit = self._todo.popleft()
        data = self._framer.begin(unit, self._probe)
        self._now = _Asked(unit, data, now_ns, now_ns, now_ns)
        self.asked += 1
        if not self._line:
            self._ids[int.from_bytes(data[:2])] = unit
            if len(self._ids) > MAX_REMEMBERED:
                del self._ids[next(iter(self._ids))]
        self.handed_over(now_ns)
        return SendRequest(unit, data)

    def handed_over(self, now_ns: int) -> None:
        """Record that the request was passed to the operating system at `now_ns`; its characters are sent from that time on."""
        if self._now is not None:
            gone_ns = now_ns + len(self._now.sent) * self._char_ns
            self._now.deadline_ns = gone_ns + self._timeout_ns
            self._now.limit_ns = self._now.deadline_ns + MAX_REPLY_CHARS * self._char_ns + REST_NS
            self._not_before_ns = self._now.began_ns + self._interval_ns

    def feed(self, data: bytes, now_ns: int) -> None:
        """Add bytes received at `now_ns`."""
        for frame in self._splitter.feed(data, now_ns):
            self._judge(frame, now_ns)
        asked = self._now
        if asked is None:
            self._not_before_ns = max(self._not_before_ns, now_ns + self._quiet_ns)
        elif self._splitter.pending:
            asked.deadline_ns = min(max(asked.deadline_ns, now_ns + REST_NS), asked.limit_ns)

    def another(self, units: Iterable[int]) -> UnitSweep:
        """Return a sweep of `units` on the same connection with the same timing."""
        return UnitSweep(
            self._framing,
            units,
            timeout_ns=self._timeout_ns,
            char_time_ns=self._char_ns,
            interval_ns=self._interval_ns,
            quiet_ns=self._quiet_ns,
            probe=self._probe,
        )

    def ask_again(self) -> None:
        """Make the current unit the next one again, because the connection broke during its request."""
        if self._now is not None:
            self._todo.appendleft(self._now.unit)
            self._now = None
        self._splitter.flush()

    def skip(self) -> int | None:
        """Skip the next unit, because the server closes the connection at each request to it, and return it; None if there is
        none.
        """
        return self._todo.popleft() if self._todo else None

    # -- received bytes ------------------------------------------------------------------------------------------

    def _judge(self, frame: ModbusFrame, now_ns: int) -> None:
        asked = self._now
        if frame.bad:
            self.noise_bytes += len(frame.raw)
            if asked is not None:
                asked.noise = True
            return
        if asked is not None and self._line and frame.raw == asked.sent:
            self.echo = True
            return
        unit = frame.unit if self._line else self._ids.get(frame.transaction, -1)
        if not self._is_answer(frame.pdu):
            self.foreign += 1
            request = _looks_like_request(frame.pdu)
            self.other_requests += self._line and request
            if asked is not None and unit == asked.unit and not request:
                asked.noise, asked.odd = True, frame.pdu
                if not self._line:  # the transaction ID shows that this is the reply, so hardly any other bytes follow
                    asked.deadline_ns = min(asked.deadline_ns, now_ns + REST_NS)
            return
        if asked is not None and unit == asked.unit:
            self._answered(asked, frame.pdu, now_ns)
        elif unit in self._past:
            self._note(unit, frame.pdu, now_ns - self._past[unit], late=True)
        else:
            self.foreign += 1

    def _is_answer(self, pdu: bytes) -> bool:
        if pdu[0] == self._probe.function | 0x80:
            return len(pdu) == 2
        return pdu[0] == self._probe.function and len(pdu) == self._reply_bytes

    def _answered(self, asked: _Asked, pdu: bytes, now_ns: int) -> None:
        self._note(asked.unit, pdu, now_ns - asked.began_ns - len(asked.sent) * self._char_ns, late=False)
        self._end(asked, now_ns)
        self._not_before_ns = max(self._not_before_ns, now_ns + self._quiet_ns)

    def _note(self, unit: int, pdu: bytes, latency_ns: int, *, late: bool) -> None:
        code = pdu[1] if pdu[0] & 0x80 else 0
        if code in NOBODY:
            self.behind_gateway.add(unit)
            return
        known = self.found.get(unit)
        answer = UnitAnswer(unit, pdu, code, max(0, latency_ns), late)
        self.found[unit] = replace(answer, late=late or known.late) if known is not None else answer
        self.damaged.pop(unit, None)

    def _give_up(self, now_ns: int) -> None:
        asked = self._now
        assert asked is not None
        for frame in self._splitter.flush():
            self._judge(frame, now_ns)
        if self._now is None:
            return  # the answer arrived while the input was flushed
        if asked.noise:
            if self._second_round:
                self.damaged[asked.unit] = asked.odd
            else:
                self._again.append(asked.unit)
            self._not_before_ns = max(self._not_before_ns, now_ns + self._quiet_ns)
        self._end(asked, now_ns)

    def _end(self, asked: _Asked, now_ns: int) -> None:
        self._past[asked.unit] = asked.began_ns
        self._now = None

    def _await_silence(self, now_ns: int) -> WaitForBytes:
        if self._silence_wanted_ns is None:
            self._silence_wanted_ns = now_ns
        elif now_ns - self._silence_wanted_ns > max(NEVER_SILENT_NS, 2 * self._interval_ns):
            self.never_silent = True
            self._not_before_ns = now_ns
        return WaitForBytes(max(self._not_before_ns, now_ns))


def _looks_like_request(pdu: bytes) -> bool:
    return 1 <= pdu[0] <= 4 and len(pdu) == 5
