"""One request and its reply, without I/O: the caller passes received bytes and the time, and gets the reply or a typed error.

A Modbus client has at most one transaction on a link. It ends exactly once: by its reply, by an error, or by its
deadline. A transaction does not wait or retry, and does not access a connection.
"""

from __future__ import annotations

from typing import Generic, TypeVar

from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.errors import Bug, FieldtwinError
from fieldtwin.gateway.protocols.modbus.frames.framing import Framer
from fieldtwin.gateway.protocols.modbus.requests.replies import Reply
from fieldtwin.gateway.protocols.modbus.requests.request import Request, parse_reply

R = TypeVar("R", bound=Reply)


class Transaction(Generic[R]):
    """One exchange: `request` to `unit` over `framer`. The reply is due `timeout_ns` after the last character was sent.

    `char_time_ns` is the transmission time of one character, 0 if it does not matter (TCP). If the request determines the length
    of the reply, its transmission time is added to the timeout.
    """

    def __init__(
        self, framer: Framer, unit: int, request: Request[R], *, timeout_ns: int, char_time_ns: int = 0
    ) -> None:
        self._framer = framer
        self._unit = unit
        self._request = request
        self._timeout_ns = timeout_ns
        self._char_time_ns = char_time_ns
        self._frame = b""
        self._heard_ns = 0
        self._settled = True
        self._granted_ns = timeout_ns
        if char_time_ns and (nominal := request.nominal_length()):
            self._granted_ns += framer.wire_length(nominal) * char_time_ns
        self.sent_ns = 0
        """The monotonic time (ns) at which the last character was sent."""
        self.deadline_ns = self._granted_ns
        """The monotonic time (ns) at which the reply has to be complete."""
        self.done = False

    @property
    def wake_ns(self) -> int:
        """Return the time (ns) at which `poll` has to be called if nothing arrives before."""
        if self._settled or not self._framer.gap_ns:
            return self.deadline_ns
        return min(self.deadline_ns, self._heard_ns + self._framer.gap_ns)

    def start(self, now_ns: int) -> bytes:
        """Return the frame to send now."""
        if self._frame:
            raise Bug("a Modbus transaction was started twice")
        self._frame = self._framer.begin(self._unit, self._request)
        self.handed_over(now_ns)
        return self._frame

    def handed_over(self, now_ns: int) -> None:
        """Note that the frame was passed to the link at `now_ns`, which is later than `start` if a buffer was full."""
        self.sent_ns = now_ns + len(self._frame) * self._char_time_ns
        self.deadline_ns = self.sent_ns + self._granted_ns

    def feed(self, data: bytes, now_ns: int) -> R | None:
        """Take the bytes that arrived. Return the reply if it is complete, else None.

        Raises `CrcError`, `Desync`, `ModbusExceptionReply` or `VerifyFailed`; the transaction is then over.
        """
        if self.done or not self._frame:
            raise _not_under_way()
        self._heard_ns = now_ns
        self._settled = False
        try:
            pdu = self._framer.feed(data, now_ns)
            return None if pdu is None else self._completed(pdu, now_ns)
        except FieldtwinError as e:
            self._failed(e)
            raise

    def poll(self, now_ns: int) -> R | None:
        """Handle the passing of time, and return a reply as `feed` does; at the deadline raises the error of `Framer.overdue`,
        usually `ReplyTimeout`.
        """
        if self.done or not self._frame:
            raise _not_under_way()
        overdue = now_ns >= self.deadline_ns
        if not self._settled and (overdue or now_ns >= self._heard_ns + self._framer.gap_ns):
            self._settled = True
            try:
                pdu = self._framer.settle()
                if pdu is not None:
                    return self._completed(pdu, self._heard_ns)
            except FieldtwinError as e:
                self._failed(e)
                raise
        if overdue:
            raise self._failed(self._framer.overdue(self._timeout_ns / NS_PER_S))
        return None

    def _completed(self, pdu: bytes, now_ns: int) -> R:
        reply = parse_reply(self._request, pdu, now_ns)
        self.done = True
        return reply

    def _failed(self, error: FieldtwinError) -> FieldtwinError:
        self.done = True
        return error.at(f"unit {self._unit}")


def _not_under_way() -> Bug:
    return Bug("bytes for a Modbus transaction that is not under way")
