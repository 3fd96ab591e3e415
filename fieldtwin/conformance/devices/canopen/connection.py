"""The connection of a check to a CAN bus. It sends any frame, receives every frame of the bus, and sends SDO requests byte
by byte.

This module does not know the purpose of a case. It sends only frames that the case's impact level permits: at the level
READ these are uploads, however unusual. Clauses are CiA 301's.
"""

from __future__ import annotations

import asyncio
from collections import deque
from dataclasses import dataclass

from fieldtwin.conformance.core.case import Impact
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.clock import NS_PER_S, Clock
from fieldtwin.gateway.core.connection import CanConnection
from fieldtwin.gateway.core.errors import Bug, ConnectionLost
from fieldtwin.gateway.protocols.canopen.eds.dictionary import ObjectDictionary
from fieldtwin.gateway.protocols.canopen.sdo.abort_codes import meaning

READS = frozenset({2, 3, 4, 5})
"""Client command specifiers that write nothing: upload, its segments, abort, block upload (7.2.4.3)."""
WRITES = frozenset({0, 1, 6})
NMT, SDO_REPLY, SDO_REQUEST, ERROR_CONTROL, LSS_REPLY, LSS_REQUEST = 0x000, 0x580, 0x600, 0x700, 0x7E4, 0x7E5
OPERATIONAL, STOPPED, PRE_OPERATIONAL = 0x05, 0x04, 0x7F
MOST_PENDING = 4096
MOST_SEGMENTS = 1000
"""Maximum number of segments of an upload: 7,000 bytes are enough for a check."""
Key = tuple[int, int]


def mux(index: int, subindex: int = 0) -> bytes:
    """Return index and subindex in the form of an SDO (7.2.4.3.3)."""
    return index.to_bytes(2, "little") + bytes((subindex,))


def shown(key: Key) -> str:
    """Return a text such as ``1018h:04``."""
    return f"{key[0]:04X}h:{key[1]:02X}"


@dataclass(frozen=True, slots=True)
class SdoReply:
    """The reply of the node's SDO server: `data` are the data bytes of the frame, empty if no reply arrived."""

    data: bytes = b""

    @property
    def abort(self) -> int:
        """Return the abort code, or 0 for a reply that is not an abort."""
        return int.from_bytes(self.data[4:8], "little") if self.data[:1] == b"\x80" else 0

    @property
    def specifier(self) -> int:
        """Return the server command specifier, -1 for silence."""
        return self.data[0] >> 5 if self.data else -1

    def __str__(self) -> str:
        if not self.data:
            return "silence"
        if self.data[:1] == b"\x80" and len(self.data) == 8:
            return f"abort {self.abort:08X} ({meaning(self.abort)})"
        return self.data.hex(" ").upper()


class NodeConnection:
    """One bus and one node on it.

    `may_write` are objects that the user gave; `dictionary` is the content of the EDS, if there is one. `state` is the
    last NMT state that the node reported by itself, None before the first.
    """

    def __init__(
        self,
        connection: CanConnection,
        clock: Clock,
        node: int,
        *,
        timeout_s: float = 0.5,
        spacing_s: float = 0.02,
        boot_s: float = 10.0,
        may_write: tuple[Key, ...] = (),
        dictionary: ObjectDictionary | None = None,
    ) -> None:
        self.node, self.timeout_s, self.boot_s = node, timeout_s, boot_s
        self.may_write, self.dictionary = may_write, dictionary
        self.impact = Impact.READ
        self.traits = frozenset({"can"})
        self.device_type = b""
        """The value of 1000h that the node gave before the first case. Every node has this object (7.5.2.1)."""
        self.long: Key | None = None
        """An object whose upload needs more than one segment."""
        self.state: int | None = None
        self.clock = clock
        self._connection = connection
        self._spacing_s = spacing_s
        self._sent_ns = clock.monotonic_ns() - round(spacing_s * NS_PER_S)
        self._pending: deque[CanFrame] = deque(maxlen=MOST_PENDING)

    # -- frames ----------------------------------------------------------------------------------------------------

    async def send(self, frame: CanFrame, *, at_once: bool = False) -> None:
        """Send a frame if the impact level permits it; keep the pause between two frames unless `at_once`."""
        self._must_be_allowed(frame)
        if not at_once:
            await self.clock.sleep_until_ns(self._sent_ns + round(self._spacing_s * NS_PER_S))
        await self._connection.send(frame)
        self._sent_ns = self.clock.monotonic_ns()

    def _must_be_allowed(self, frame: CanFrame) -> None:
        if self.impact is Impact.DISRUPT:
            return
        specifier = frame.data[0] >> 5 if frame.data else -1
        to_server = frame.can_id == SDO_REQUEST + self.node and not frame.remote
        if to_server and (specifier in READS or (self.impact is Impact.WRITE and specifier in WRITES)):
            return
        raise Bug(f"a check with impact level {self.impact.value} would send {frame}")

    async def hear(self, cob_id: int, within_s: float | None = None, *, remote: bool = False) -> CanFrame | None:
        """Return the next frame with that identifier, None if none arrived in time; the default of `within_s` is the timeout."""
        try:
            async with asyncio.timeout(self.timeout_s if within_s is None else within_s):
                while True:
                    frame = await self._next()
                    if frame.can_id == cob_id and not frame.extended and frame.remote is remote:
                        return frame
        except TimeoutError:
            return None

    async def _next(self) -> CanFrame:
        frame = await self._connection.recv()
        if (
            frame.can_id == ERROR_CONTROL + self.node
            and len(frame.data) == 1
            and not frame.remote
            and not frame.extended
        ):
            self.state = frame.data[0] & 0x7F or PRE_OPERATIONAL
        self._pending.append(frame)
        return frame

    async def listen(self, s: float) -> list[CanFrame]:
        """Return all frames received within `s` seconds."""
        self._pending.clear()
        try:
            async with asyncio.timeout(s):
                while True:
                    await self._next()
        except TimeoutError:
            return list(self._pending)

    async def pause(self) -> None:
        """Wait, so that the node has time to execute a command."""
        await asyncio.sleep(max(0.05, self._spacing_s))

    def forget(self) -> None:
        """Discard all frames received so far."""
        while self._connection.inbound.data_stream:
            frame = self._connection.inbound.read()
            if frame.can_id == ERROR_CONTROL + self.node and len(frame.data) == 1:
                self.state = frame.data[0] & 0x7F or PRE_OPERATIONAL
        self._pending.clear()

    # -- SDO ---------------------------------------------------------------------------------------------------------

    async def send_sdo(self, data: bytes, *, at_once: bool = False) -> None:
        """Send an SDO frame to the server without padding, even if it is shorter than 8 bytes."""
        await self.send(CanFrame(SDO_REQUEST + self.node, data), at_once=at_once)

    async def ask(self, data: bytes, within_s: float | None = None) -> SdoReply:
        """Send an SDO request, padded to 8 bytes, and return the reply."""
        self.forget()
        await self.send_sdo(data.ljust(8, b"\0"))
        return await self.reply(within_s)

    async def reply(self, within_s: float | None = None) -> SdoReply:
        """Return the next frame of the node's SDO server; its data is empty if none arrives in time."""
        frame = await self.hear(SDO_REPLY + self.node, within_s)
        return SdoReply(frame.data if frame is not None else b"")

    async def abandon(self, key: Key, code: int = 0x0800_0000) -> None:
        """Send the client's abort, which ends a transfer and is not answered."""
        await self.send_sdo(b"\x80" + mux(*key) + code.to_bytes(4, "little"))

    async def upload(self, key: Key) -> bytes | SdoReply:
        """Upload an object expedited or in segments; return its value, or the reply with which the upload failed.

        The upload is aborted after `MOST_SEGMENTS` segments; the value is then the part that has arrived, about 7,000 bytes.
        """
        reply = await self.ask(b"\x40" + mux(*key))
        if reply.specifier != 2 or reply.data[1:4] != mux(*key):
            return reply
        if reply.data[0] & 2:  # the transfer is expedited
            unused = reply.data[0] >> 2 & 3 if reply.data[0] & 1 else 0
            return reply.data[4 : 8 - unused]
        value, toggle = b"", 0
        for _ in range(MOST_SEGMENTS):
            segment = await self.ask(bytes((0x60 | toggle,)))
            if segment.specifier != 0 or segment.data[0] & 0x10 != toggle:
                return segment
            value += segment.data[1 : 8 - (segment.data[0] >> 1 & 7)]
            if segment.data[0] & 1:
                return value
            toggle ^= 0x10
        await self.abandon(key)
        return value

    async def download(self, key: Key, value: bytes) -> SdoReply:
        """Download an object expedited or in segments; return the last reply."""
        if 0 < len(value) <= 4:
            return await self.ask(bytes((0x23 | (4 - len(value)) << 2,)) + mux(*key) + value)
        reply = await self.ask(b"\x21" + mux(*key) + len(value).to_bytes(4, "little"))
        toggle = 0
        for at in range(0, max(1, len(value)), 7):
            if reply.specifier not in (1, 3):
                return reply
            piece = value[at : at + 7]
            last = at + 7 >= len(value)
            reply = await self.ask(bytes((toggle | (7 - len(piece)) << 1 | last,)) + piece)
            toggle ^= 0x10
        return reply

    # -- NMT ---------------------------------------------------------------------------------------------------------

    async def command(self, command: int) -> None:
        """Send an NMT command to this node (7.2.8.2.1)."""
        await self.send(CanFrame(NMT, bytes((command, self.node))))

    async def boots(self) -> bool:
        """Wait for a boot-up message, and return whether it arrived."""
        loop = asyncio.get_running_loop()
        end = loop.time() + self.boot_s
        while (left := end - loop.time()) > 0:
            frame = await self.hear(ERROR_CONTROL + self.node, left)
            if frame is not None and frame.data == b"\0":
                return True
        return False

    # -- normal behaviour --------------------------------------------------------------------------------------------

    async def still_good(self) -> str:
        """Return an empty string if the node still returns the same value for object 1000h, else a description of the reply."""
        found = await self.upload((0x1000, 0))
        if found == self.device_type:
            return ""
        return str(found) if isinstance(found, SdoReply) else f"1000h is {found.hex(' ').upper()}"

    async def settle(self) -> bool:
        """End any open SDO transfer, and return whether the node then answers normally."""
        for attempt in range(3):
            try:
                await self.abandon((0x1000, 0))
                if attempt:
                    await self.listen(self.timeout_s)
                self.forget()
                if not await self.still_good():
                    return True
            except ConnectionLost:
                return False
        return False
