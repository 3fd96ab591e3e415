"""The LSS master (CiA 305): gives node ids and bit rates to slaves that are told apart by their identity.

Asynchronous around `lss`; sends over the CANopen master and is told what comes on 7E4h. One request at a time. Replies
of several slaves at once look like one (they are the same bits), and one may come later than another: wherever more than one
slave may answer, the whole time for replies is waited for, so that no late one passes for the answer to the next
request (CO-056, CO-059).
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Awaitable, Callable

from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.clock import NS_PER_S, Clock
from fieldtwin.gateway.core.errors import Desync, ReplyTimeout, UsageError
from fieldtwin.gateway.protocols.canopen import lss
from fieldtwin.gateway.protocols.canopen.lss import LssAddress

MAX_INBOX = 64
REPLY_S = 0.1
"""How long a slave may take; the time in which all have answered."""
STORE_S = 2.0
"""Non-volatile memory is slow."""


class LssMaster:
    """`send` puts a frame on the bus; `on_reply` is to be called with the data of each frame on 7E4h.

    `ignored` counts replies that answered nothing. Raises `ReplyTimeout` where nobody answers, `LssRefused` where a slave
    says no, `Desync` where what answers makes no sense.
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
        """A frame came on 7E4h."""
        if self._waiting and len(data) == 8:
            self._inbox.append(data)
            self._arrived.set()
        else:
            self.ignored += 1

    # -- states ---------------------------------------------------------------------------------------------------

    async def switch_all(self, *, configuration: bool) -> None:
        """Switch every slave to configuration or to waiting. Unconfirmed.

        A slave that was given a node id and had none boots on the way to waiting.
        """
        async with self._turn:
            await self._send(lss.request(lss.SWITCH_GLOBAL, bytes([configuration])))

    async def select(self, address: LssAddress) -> None:
        """Switch the one slave with `address` to configuration; `ReplyTimeout` when there is none."""
        async with self._turn:
            frames = [
                lss.request(command, part.to_bytes(4, "little"))
                for command, part in zip(lss.SWITCH_SELECTIVE, address.parts, strict=True)
            ]
            await self._ask(frames, lss.SWITCHED, f"no slave is {address}")

    # -- the slave in configuration ---------------------------------------------------------------------------------

    async def configure_node_id(self, node: int) -> None:
        """Give the slave in configuration its node id (255: none). It counts from the next reset or switch to waiting."""
        lss.check_node_id(node)
        async with self._turn:
            reply = await self._ask([lss.request(lss.CONFIGURE_NODE_ID, bytes([node]))], lss.CONFIGURE_NODE_ID)
        lss.check_result(f"node id {node}", reply)

    async def configure_bit_rate(self, bit_rate: int) -> None:
        """Give the slave in configuration a bit rate of the standard table; it counts from `activate_bit_rate`."""
        if bit_rate not in lss.BIT_RATES:
            known = ", ".join(str(rate) for rate in lss.BIT_RATES)
            raise UsageError("not a bit rate of LSS", expected=known, got=str(bit_rate))
        async with self._turn:
            frame = lss.request(lss.CONFIGURE_BIT_TIMING, bytes([0, lss.BIT_RATES[bit_rate]]))
            reply = await self._ask([frame], lss.CONFIGURE_BIT_TIMING)
        lss.check_result(f"bit rate {bit_rate}", reply)

    async def activate_bit_rate(self, delay_ms: int) -> None:
        """All slaves in configuration: silence for `delay_ms`, the new bit rate, silence again. Unconfirmed."""
        if not 0 <= delay_ms <= 0xFFFF:
            raise UsageError("the switch delay", expected="0 to 65535 ms", got=str(delay_ms))
        async with self._turn:
            await self._send(lss.request(lss.ACTIVATE_BIT_TIMING, delay_ms.to_bytes(2, "little")))

    async def store(self) -> None:
        """Let the slave in configuration keep node id and bit rate over a power cycle."""
        async with self._turn:
            reply = await self._ask([lss.request(lss.STORE)], lss.STORE, wait_s=STORE_S)
        lss.check_result("store", reply)

    async def inquire_address(self) -> LssAddress:
        """Read the identity of the slave in configuration."""
        parts = []
        async with self._turn:
            for command in lss.INQUIRE:
                reply = await self._ask([lss.request(command)], command)
                parts.append(int.from_bytes(reply[1:5], "little"))
        return LssAddress(*parts)

    async def inquire_node_id(self) -> int:
        """Read the node id of the slave in configuration: 1 to 127, 255 where it has none."""
        async with self._turn:
            return (await self._ask([lss.request(lss.INQUIRE_NODE_ID)], lss.INQUIRE_NODE_ID))[1]

    # -- who is there -----------------------------------------------------------------------------------------------

    async def any_unconfigured(self) -> bool:
        """Whether a slave without a node id is on the bus (those with one keep quiet: CO-057)."""
        async with self._turn:
            return await self._anybody(lss.request(lss.IDENTIFY_NON_CONFIGURED), lss.NON_CONFIGURED_FOUND)

    async def fastscan(self, *, verify: bool = True) -> LssAddress | None:
        """Find one slave without a node id and leave it in configuration; None when there is none.

        Of several the one with the smallest numbers is found; the next scan finds the next, but without `verify`: a slave
        found before is in configuration and would answer too. 133 requests, each as long as a reply may take. Raises
        `Desync` when the answers contradict each other, or the slave that was found says that it is another.
        """
        async with self._turn:
            if not await self._anybody(lss.fastscan(0, lss.ANYBODY, 0, 0), lss.SLAVE_FOUND):
                return None
            found = LssAddress(*[await self._scan_part(part) for part in range(4)])
        if verify and (told := await self.inquire_address()) != found:
            raise Desync("the slave that fastscan found is another", expected=str(found), got=str(told))
        return found

    async def _scan_part(self, part: int) -> int:
        number = 0
        for bit in range(31, -1, -1):
            if not await self._anybody(lss.fastscan(number, bit, part, part), lss.SLAVE_FOUND):
                number |= 1 << bit
        if not await self._anybody(lss.fastscan(number, 0, part, (part + 1) % 4), lss.SLAVE_FOUND):
            raise Desync(f"nobody stands to part {part} of the address that fastscan found", got=f"{number:08X}h")
        return number

    async def assign(self, address: LssAddress, node: int, *, store: bool = True) -> int:
        """Give the slave with `address` the node id `node` and switch it to waiting; the node id that it had.

        One that had none (255) boots under the new one at once, another when its communication is reset. Nobody else's
        `assign` comes in between: a slave that another call selected would get the node id too.
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

    # -- asking -----------------------------------------------------------------------------------------------------

    async def _ask(self, frames: list[CanFrame], expected: int, why: str = "", wait_s: float = 0.0) -> bytes:
        """Send and return the reply with that specifier; others are passed over and counted."""
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

    async def _anybody(self, frame: CanFrame, expected: int) -> bool:
        """Whether at least one slave answers. The whole time is waited for: the next question must not meet a late one."""
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
