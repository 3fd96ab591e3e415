"""The LSS master (CiA 305): gives node IDs and bit rates to slaves that are addressed by their identity.

This is the asynchronous part; `frames` encodes the requests. Requests are sent over the CANopen master, one at a time, and the
replies are received on 7E4h. Simultaneous replies of several slaves have the same bits and look like one reply. A reply of
another slave may also arrive later. So if more than one slave may answer, the master waits for the whole reply time; otherwise a
late reply could be taken for the answer to the next request (CO-056, CO-059).
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Awaitable, Callable

from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.clock import NS_PER_S, Clock
from fieldtwin.gateway.core.errors import Desync, ReplyTimeout, UsageError
from fieldtwin.gateway.protocols.canopen.lss import frames as lss
from fieldtwin.gateway.protocols.canopen.lss.frames import LssAddress

MAX_INBOX = 64
REPLY_S = 0.1
"""The reply time of a slave in seconds, in which all slaves have answered."""
STORE_S = 2.0
"""Non-volatile memory is slow, so storing gets a longer timeout, in seconds."""


class LssMaster:
    """An LSS master. `send` puts a frame on the bus; call `on_reply` with the data of each frame on 7E4h.

    `ignored` counts replies that answered no request. The methods raise `ReplyTimeout` if no slave answers, `LssRefused` if a
    slave refuses, and `Desync` if a reply is invalid.
    """

    def __init__(self, send: Callable[[CanFrame], Awaitable[None]], clock: Clock, *, reply_s: float = REPLY_S) -> None:
        self._send = send
        self._clock = clock
        self._reply_s = reply_s
        self._turn = asyncio.Lock()
        self._procedure = asyncio.Lock()
        self._inbox: deque[bytes] = deque(maxlen=MAX_INBOX)
        self._arrived = asyncio.Event()
        self._waiting = False
        self.ignored = 0

    def on_reply(self, data: bytes, t_ns: int) -> None:
        """Handle a frame that arrived on 7E4h."""
        if self._waiting and len(data) == 8:
            self._inbox.append(data)
            self._arrived.set()
        else:
            self.ignored += 1

    # -- states ---------------------------------------------------------------------------------------------------

    async def switch_all(self, *, configuration: bool) -> None:
        """Switch every slave to the configuration or the waiting state. The service is not confirmed.

        A slave that had no node ID and got one boots when it enters the waiting state.
        """
        async with self._turn:
            await self._send(lss.request(lss.SWITCH_GLOBAL, bytes([configuration])))

    async def select(self, address: LssAddress) -> None:
        """Switch the one slave with `address` to the configuration state. Raises `ReplyTimeout` if there is no such slave."""
        async with self._turn:
            frames = [
                lss.request(command, part.to_bytes(4, "little"))
                for command, part in zip(lss.SWITCH_SELECTIVE, address.parts, strict=True)
            ]
            await self._ask(frames, lss.SWITCHED, f"no slave is {address}")

    # -- slave in configuration -------------------------------------------------------------------------------------

    async def configure_node_id(self, node: int) -> None:
        """Assign a node ID (255: none) to the slave in the configuration state.

        It takes effect at the next reset or switch to the waiting state."""
        lss.check_node_id(node)
        async with self._turn:
            reply = await self._ask([lss.request(lss.CONFIGURE_NODE_ID, bytes([node]))], lss.CONFIGURE_NODE_ID)
        lss.check_result(f"node id {node}", reply)

    async def configure_bit_rate(self, bit_rate: int) -> None:
        """Set the bit rate of the slave in the configuration state, from the standard table.

        `activate_bit_rate` makes it effective.
        """
        if bit_rate not in lss.BIT_RATES:
            known = ", ".join(str(rate) for rate in lss.BIT_RATES)
            raise UsageError("not a bit rate of LSS", expected=known, got=str(bit_rate))
        async with self._turn:
            frame = lss.request(lss.CONFIGURE_BIT_TIMING, bytes([0, lss.BIT_RATES[bit_rate]]))
            reply = await self._ask([frame], lss.CONFIGURE_BIT_TIMING)
        lss.check_result(f"bit rate {bit_rate}", reply)

    async def activate_bit_rate(self, delay_ms: int) -> None:
        """Make all slaves in the configuration state pause for `delay_ms`, change the bit rate, and pause again.

        Not confirmed.
        """
        if not 0 <= delay_ms <= 0xFFFF:
            raise UsageError("the switch delay", expected="0 to 65535 ms", got=str(delay_ms))
        async with self._turn:
            await self._send(lss.request(lss.ACTIVATE_BIT_TIMING, delay_ms.to_bytes(2, "little")))

    async def store(self) -> None:
        """Make the slave in the configuration state save node ID and bit rate in non-volatile memory."""
        async with self._turn:
            reply = await self._ask([lss.request(lss.STORE)], lss.STORE, wait_s=STORE_S)
        lss.check_result("store", reply)

    async def inquire_address(self) -> LssAddress:
        """Read the identity of the slave in the configuration state."""
        parts = []
        async with self._turn:
            for command in lss.INQUIRE:
                reply = await self._ask([lss.request(command)], command)
                parts.append(int.from_bytes(reply[1:5], "little"))
        return LssAddress(*parts)

    async def inquire_node_id(self) -> int:
        """Read the node ID of the slave in the configuration state: 1 to 127, or 255 if it has no node ID."""
        async with self._turn:
            return (await self._ask([lss.request(lss.INQUIRE_NODE_ID)], lss.INQUIRE_NODE_ID))[1]

    # -- finding slaves ---------------------------------------------------------------------------------------------

    async def any_unconfigured(self) -> bool:
        """Return whether a slave without a node ID is on the bus (slaves that have a node ID do not answer: CO-057)."""
        async with self._turn:
            return await self._any_answer(lss.request(lss.IDENTIFY_NON_CONFIGURED), lss.NON_CONFIGURED_FOUND)

    async def fastscan(self, *, verify: bool = True) -> LssAddress | None:
        """Find one slave without a node ID and leave it in the configuration state; return None if there is no such slave.

        If there are several, it finds the slave with the smallest numbers, and the next scan finds the next slave. While a slave
        that was found before is still in the configuration state, scan without `verify`, because that slave would answer the
        inquiry too. A scan takes 133 requests, each of which lasts for the reply time. Raises `Desync` if the answers
        contradict each other, or if the slave that was found reports a different identity.
        """
        async with self._turn:
            if not await self._any_answer(lss.fastscan(0, lss.ANY_SLAVE, 0, 0), lss.SLAVE_FOUND):
                return None
            found = LssAddress(*[await self._scan_part(part) for part in range(4)])
        if verify and (reported := await self.inquire_address()) != found:
            raise Desync("fastscan found a different slave", expected=str(found), got=str(reported))
        return found

    async def _scan_part(self, part: int) -> int:
        number = 0
        for bit in range(31, -1, -1):
            if not await self._any_answer(lss.fastscan(number, bit, part, part), lss.SLAVE_FOUND):
                number |= 1 << bit
        if not await self._any_answer(lss.fastscan(number, 0, part, (part + 1) % 4), lss.SLAVE_FOUND):
            raise Desync(f"no slave confirms part {part} of the address that fastscan found", got=f"{number:08X}h")
        return number

    async def assign(self, address: LssAddress, node: int, *, store: bool = True) -> int:
        """Give the slave with `address` the node ID `node` and switch it to the waiting state; return its previous node ID.

        A slave that had no node ID (255) boots immediately with the new one; any other slave boots when its communication is
        reset. Calls of `assign` do not overlap, because a slave that another call has selected would also get the node ID.
        """
        lss.check_node_id(node)
        async with self._procedure:
            await self.switch_all(configuration=False)
            await self.select(address)
            try:
                had = await self.inquire_node_id()
                await self.configure_node_id(node)
                if store:
                    await self.store()
            finally:
                await self.switch_all(configuration=False)
        return had

    # -- requests ---------------------------------------------------------------------------------------------------

    async def _ask(self, frames: list[CanFrame], expected: int, why: str = "", wait_s: float = 0.0) -> bytes:
        """Send `frames` and return the first reply with the command specifier `expected`; other replies are skipped and counted.

        Raises `ReplyTimeout`, with the text `why`, if none arrives within `wait_s` seconds (0: the usual reply time).
        """
        self._begin()
        try:
            for frame in frames:
                await self._send(frame)
            deadline_ns = self._clock.monotonic_ns() + int((wait_s or self._reply_s) * NS_PER_S)
            while (reply := await self._next(deadline_ns)) is not None:
                if reply[0] == expected:
                    return reply
                self.ignored += 1
        finally:
            self._waiting = False
        raise ReplyTimeout(why or "no LSS slave answers", hint="is one in configuration state?" if not why else "")

    async def _any_answer(self, frame: CanFrame, expected: int) -> bool:
        """Return whether at least one slave answers. Always wait for the whole reply time, so that no late reply is left."""
        self._begin()
        heard = False
        try:
            await self._send(frame)
            deadline_ns = self._clock.monotonic_ns() + int(self._reply_s * NS_PER_S)
            while (reply := await self._next(deadline_ns)) is not None:
                heard = heard or reply[0] == expected
                self.ignored += reply[0] != expected
        finally:
            self._waiting = False
        return heard

    def _begin(self) -> None:
        self.ignored += len(self._inbox)
        self._inbox.clear()
        self._waiting = True

    async def _next(self, deadline_ns: int) -> bytes | None:
        while not self._inbox:
            left_s = (deadline_ns - self._clock.monotonic_ns()) / NS_PER_S
            if left_s <= 0:
                return None
            self._arrived.clear()
            try:
                async with asyncio.timeout(left_s):
                    await self._arrived.wait()
            except TimeoutError:
                continue
        return self._inbox.popleft()
