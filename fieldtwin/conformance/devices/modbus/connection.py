"""The connection of a check to a Modbus device. It sends any bytes, receives every byte, and knows the device's normal
answers.

This module does not know the purpose of a case. It permits only requests within the case's impact level, by a list of
functions: a case that would send others is a bug of fieldtwin.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import dataclass

from fieldtwin.conformance.core.case import Impact
from fieldtwin.conformance.devices.modbus.frames import ReceivedReply, framed, replies, short
from fieldtwin.gateway.core.clock import NS_PER_S, Clock
from fieldtwin.gateway.core.connection import ByteConnection
from fieldtwin.gateway.core.errors import Bug, ConnectionLost, Unreachable

READS = frozenset({0x01, 0x02, 0x03, 0x04, 0x11, 0x18, 0x2B})
"""Functions that change nothing in any conforming device, whatever their parameters."""
WRITES = frozenset({0x05, 0x06, 0x0F, 0x10, 0x16, 0x17})
IDENTIFICATION = b"\x2b\x0e"
"""The permitted subtype of function 2B, which also carries CANopen services that may write."""
MOST_HEARD = 8192
"""Maximum number of bytes that are received after a request; the check stops receiving if the device sends more."""
CALM_S = 0.8
"""In seconds: after this silence on a serial line no receiver waits for the rest of a frame, however slow its timers are
(libmodbus: 0.5 s).
"""
PATIENCE = 3
"""A missing answer counts as silence after this number of timeouts. It is larger than 1, because a slow device is not faulty."""
FIRST_TRANSACTION = 0x0100
"""First transaction ID of each case: the same case always sends the same bytes, whatever ran before."""
GATEWAY_SAYS_NO = (0x0A, 0x0B)
"""Exceptions with which a gateway reports that the addressed device is missing."""

Open = Callable[[], Awaitable[ByteConnection]]


@dataclass(frozen=True, slots=True)
class Received:
    """The received data: whole replies (`answers`), other bytes (`rest`), and whether the device closed the connection
    (`closed`).
    """

    answers: tuple[ReceivedReply, ...]
    rest: bytes = b""
    closed: bool = False

    @property
    def first(self) -> ReceivedReply | None:
        return self.answers[0] if self.answers else None

    @property
    def nothing(self) -> bool:
        return not self.answers and not self.rest

    def __str__(self) -> str:
        said = [str(answer) for answer in self.answers]
        said += [f"{short(self.rest)}, which is not a frame"] if self.rest else []
        said += ["hangs up"] if self.closed else []
        return ", ".join(said) or "silence"


class DeviceConnection:
    """One connection to one unit.

    `framing` is rtu, ascii, mbap or udp; `traits` describe the transport for cases (the framing, ``serial`` or
    ``stream``). `timeout_s` is the time for a reply, and for detecting silence; `spacing_s` is the pause between two
    requests; `char_s` is the time of a character on a serial line.
    """

    def __init__(
        self,
        open_wire: Open,
        clock: Clock,
        framing: str,
        unit: int,
        *,
        traits: frozenset[str] = frozenset(),
        timeout_s: float = 1.0,
        spacing_s: float = 0.05,
        char_s: float = 0.0,
        echo: bool = False,
    ) -> None:
        self.framing, self.unit, self.traits = framing, unit, traits
        self.timeout_s, self.char_s = timeout_s, char_s
        self.pause_s = max(4 * char_s, 0.005)
        """Pause in seconds that ends any frame (SL 2.5.1.1: 3.5 characters, 1.75 ms at least), with a margin."""
        self.impact = Impact.READ
        self.good = b""
        """PDU of the request that tests normal operation: a read."""
        self.good_reply = b""
        self.readable: dict[int, tuple[int, int]] = {}
        """Function -> (address, count) of a read that is answered with values."""
        self.refused: dict[int, int] = {}
        """Function -> the exception code with which the device refused the last read by it."""
        self.may_write: dict[str, tuple[int, int]] = {}
        """``holding`` and ``coil`` -> (address, count) of cells that the user named for writing."""
        self._open, self.clock = open_wire, clock
        self._spacing_s = max(spacing_s, self.pause_s) if char_s else spacing_s
        self._echo = echo
        self._echo_left = b""
        self._connection: ByteConnection | None = None
        self._closed = False
        self._transaction = 0
        self._quiet_since_ns = clock.monotonic_ns() - round(self._spacing_s * NS_PER_S)

    # -- the connection ------------------------------------------------------------------------------------------

    async def reopen(self) -> None:
        """Open a new connection after closing the old one. Raises `Unreachable`."""
        await self.aclose()
        self._connection = await self._open()
        self._closed = False

    async def open_another(self) -> ByteConnection:
        """Open one more connection; the caller closes it."""
        return await self._open()

    async def aclose(self) -> None:
        connection, self._connection = self._connection, None
        if connection is not None:
            await connection.aclose()

    @property
    def serial(self) -> bool:
        return "serial" in self.traits

    # -- saying and hearing ----------------------------------------------------------------------------------------

    def next_transaction(self) -> int:
        self._transaction = self._transaction % 0xFFFE + 1
        return self._transaction

    def frame(self, pdu: bytes, unit: int | None = None, transaction: int | None = None) -> bytes:
        """Return the frame of `pdu` on this connection."""
        number = self.next_transaction() if transaction is None else transaction
        return framed(self.framing, self.unit if unit is None else unit, pdu, number)

    async def send(self, data: bytes, *carries: bytes, at_once: bool = False) -> None:
        """Send `data`, which contains the PDUs `carries`; keep the pause between two requests unless `at_once`."""
        for pdu in carries:
            self._must_be_allowed(pdu)
        if self._connection is None or self._closed:
            await self.reopen()
        if not at_once:
            await self._rest()
        assert self._connection is not None
        try:
            await self._connection.write(data)
        except ConnectionLost:
            self._closed = True
        if self._echo:
            self._echo_left += data
        self._quiet_since_ns = self.clock.monotonic_ns() + round(len(data) * self.char_s * NS_PER_S)

    def _must_be_allowed(self, pdu: bytes) -> None:
        if self.impact is Impact.DISRUPT or (pdu[0] in READS and (pdu[0] != 0x2B or pdu[:2] == IDENTIFICATION)):
            return
        if self.impact is Impact.WRITE and pdu[0] in WRITES:
            return
        raise Bug(f"a check with impact level {self.impact.value} would send function {pdu[0]:02X}h")

    async def _rest(self) -> None:
        await self.clock.sleep_until_ns(self._quiet_since_ns + round(self._spacing_s * NS_PER_S))

    async def hear(self, count: int = 1, within_s: float | None = None) -> Received:
        """Receive until `count` whole replies have arrived, or the time is over; with ``count=0`` receive during the whole
        time.

        The time is `within_s` seconds, by default the timeout; it is extended while a reply is arriving.
        """
        data, closed = await self._bytes(count, self.timeout_s if within_s is None else within_s)
        answers, rest = replies(self.framing, data)
        return Received(tuple(answers), rest, closed)

    async def _bytes(self, count: int, within_s: float) -> tuple[bytes, bool]:
        data = b""
        end_ns = max(self.clock.monotonic_ns(), self._quiet_since_ns) + round(within_s * NS_PER_S)
        while not self._closed and self._connection is not None and len(data) < MOST_HEARD:
            left_s = (end_ns - self.clock.monotonic_ns()) / NS_PER_S
            if left_s <= 0 or (count and len(replies(self.framing, data)[0]) >= count):
                break
            try:
                chunk = await self._connection.read_within(left_s)
            except ConnectionLost:
                self._closed = True
                break
            if chunk:
                data += self._without_echo(chunk)
                self._quiet_since_ns = self.clock.monotonic_ns()
                if count:  # a reply has begun, and its remaining bytes may take as long as a whole frame
                    end_ns = max(end_ns, self._quiet_since_ns + round((self.pause_s + 0.05) * NS_PER_S))
        return data, self._closed

    def _without_echo(self, chunk: bytes) -> bytes:
        same = 0
        while same < min(len(chunk), len(self._echo_left)) and chunk[same] == self._echo_left[same]:
            same += 1
        self._echo_left = self._echo_left[same:] if same else b""
        return chunk[same:]

    async def ask(self, pdu: bytes, unit: int | None = None, *, due: bool = True) -> Received:
        """Send a request in a correct frame and return the received data.

        `due`: an answer is expected, so the function waits for `PATIENCE` timeouts, else for one. On a connection with
        transaction IDs, a reply to an earlier request is skipped if the reply to this request follows.
        """
        number = self.next_transaction()
        await self.send(self.frame(pdu, unit, number), pdu)
        heard = await self.hear(within_s=self.timeout_s * (PATIENCE if due else 1))
        if self.framing in ("mbap", "udp"):
            late = [a for a in heard.answers if a.transaction != number]
            # this is the reply to an earlier request; the reply to the present request may follow
            if late and len(late) == len(heard.answers):
                more = await self.hear()
                ours = tuple(a for a in more.answers if a.transaction == number)
                return Received(ours or heard.answers, heard.rest + more.rest, more.closed)
        return heard

    async def pause(self, s: float) -> None:
        await asyncio.sleep(s)

    async def drain(self) -> Received:
        """Receive and return the bytes that have arrived without a request."""
        return await self.hear(0, self.pause_s)

    # -- normal behaviour -----------------------------------------------------------------------------------------

    def is_good(self, answer: ReceivedReply | None) -> bool:
        """Return whether an answer is the unit's reply to `good`, of the usual shape; the values may have changed."""
        if answer is None or answer.unit != self.unit:
            return False
        usual = self.good_reply
        if usual[0] & 0x80:
            return answer.pdu == usual
        return answer.pdu[:2] == usual[:2] and len(answer.pdu) == len(usual)

    async def still_good(self, *, at_once: bool = False) -> str:
        """Return an empty string when `good` is answered as usual, else a description of the received data.

        On a serial line the request is sent after a silence of `CALM_S`, unless `at_once`.
        """
        if self.serial and not at_once:
            await self.clock.sleep_until_ns(self._quiet_since_ns + round(CALM_S * NS_PER_S))
        heard = await self.ask(self.good)
        return "" if len(heard.answers) == 1 and self.is_good(heard.first) and not heard.rest else str(heard)

    async def settle(self) -> bool:
        """Restore normal operation: discard received bytes, and if necessary wait or open a new connection.

        Return whether the device then answers normally.
        """
        for attempt in range(3):
            try:
                if attempt or self._connection is None or self._closed:
                    if self.serial and self._connection is not None:
                        await self.pause(self.timeout_s)
                    else:
                        await self.reopen()
                await self.drain()
                self._echo_left = b""
                if not await self.still_good(at_once=True):
                    self._transaction = FIRST_TRANSACTION
                    return True
            except Unreachable:
                await self.pause(self.timeout_s)
        return False
