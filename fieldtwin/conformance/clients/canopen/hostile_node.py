"""The simulated CANopen nodes with which a master under test communicates. They answer correctly until a test case begins.

The module records all frames and gives no verdict.
"""

from __future__ import annotations

import asyncio
from collections.abc import Collection

from fieldtwin.conformance.clients.canopen.device import BOOT_UP, STOPPED, HonestNode
from fieldtwin.conformance.clients.canopen.setup import CanopenCase, SdoRequestContext, SendFrame
from fieldtwin.conformance.clients.recorder import Recorder
from fieldtwin.conformance.core.observation import Garbled, ReplySent, RequestSeen, Sent, Word
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.connection import CanConnection
from fieldtwin.gateway.core.errors import ConnectionLost

SDO_REQUEST, HEARTBEAT, NMT = 0x600, 0x700, 0x000
ABORT, DOWNLOAD, UPLOAD, BLOCK_UPLOAD, BLOCK_DOWNLOAD = 0x80, 1, 2, 5, 6
_WANTED = {"upload": UPLOAD, "download": DOWNLOAD, "block upload": BLOCK_UPLOAD, "block download": BLOCK_DOWNLOAD}
_BLOCK_ACKNOWLEDGED = 0xA2
STOP, RESET_COMMUNICATION, TOGGLE = 0x02, 0x82, 0x80
BEHIND_S = 0.050
MASTER = 1


class HostileNode:
    """All simulated nodes of a test: the counterpart of
    `fieldtwin.conformance.clients.modbus.hostile_server.HostileServer`.

    `size` is the number of bytes of an object, `heartbeat_s` the heartbeat period in seconds (0: no heartbeat). `nodes` are
    the node IDs that exist from the start and send a boot-up message; the first request to any other node ID creates that
    node.
    """

    def __init__(
        self,
        words: tuple[int, int, int],
        *,
        size: int = 4,
        held: dict[tuple[int, int], bytes] | None = None,
        nodes: Collection[int] = (),
        heartbeat_s: float = 1.0,
    ) -> None:
        self.recorder = Recorder()
        self.timeout_s = 1.0
        self.strikes = self.struck = self.first_ns = self.last_ns = self.pending = 0
        self._words, self._size, self._held = words, size, held or {}
        self._word = words[0]
        self._nodes: dict[int, HonestNode] = {n: self._born() for n in nodes}
        self._heartbeat_s = heartbeat_s
        self._case: CanopenCase | None = None
        self._playing: CanopenCase | None = None
        self._memory: dict[str, int] | None = None
        self._muted = ""
        self._beat_late_s = 0.0
        self._guarded: dict[int, int] = {}
        self._free_ns = 0
        self._loop = asyncio.get_running_loop()

    def now_ns(self) -> int:
        return round(self._loop.time() * NS_PER_S)

    def hold(self, word: Word) -> int:
        """Let all objects hold the correct value that `word` names, from now on; return this value."""
        self._word = self._words[0] if word is Word.FIRST else self._words[1]
        for node in self._nodes.values():
            node.objects.word = self._word
        return self._word

    def begin(self, case: CanopenCase, strikes: int) -> None:
        """Run `case` from the next matching transfer on, until it has answered `strikes` transfers wrongly or `end` is called."""
        self._case, self.strikes, self._memory = case, strikes, None
        self.struck = self.first_ns = self.last_ns = 0

    def end(self) -> None:
        """Answer all new requests correctly from now on; a transfer in progress continues to its end."""
        self._case = None

    async def serve(self, connection: CanConnection) -> None:
        """Serve the nodes on a CAN bus until the bus is lost."""
        self._connection = connection
        async with Nursery() as nursery:
            self._nursery = nursery
            for node in self._nodes:
                await connection.send(CanFrame(HEARTBEAT + node, bytes((BOOT_UP,))))
            if self._heartbeat_s:
                nursery.start(self._live(), "heartbeats")
            while True:
                await self._heard(await connection.recv())

    # -- frames ---------------------------------------------------------------------------------------------------

    async def _heard(self, frame: CanFrame) -> None:
        now_ns, node = self.now_ns(), frame.can_id - SDO_REQUEST
        if frame.remote and not frame.extended and HEARTBEAT < frame.can_id < HEARTBEAT + 0x80:
            await self._guard(frame.can_id - HEARTBEAT, now_ns)
        if frame.error or frame.extended or frame.remote:
            return
        if not 1 <= node <= 127:
            self.recorder.add(Sent(now_ns, MASTER, frame.can_id.to_bytes(2, "big") + frame.data))
            if frame.can_id == NMT and len(frame.data) == 2:
                await self._commanded(frame.data[0], frame.data[1])
        elif len(frame.data) != 8:
            self.recorder.add(Garbled(now_ns, MASTER, frame.data))
        elif frame.data[0] == ABORT:
            self.recorder.add(Sent(now_ns, MASTER, frame.can_id.to_bytes(2, "big") + frame.data))
            self._node(node).answer(frame.data, now_ns)
            self._memory = None
        else:
            self._asked(node, frame.data, now_ns)

    def _asked(self, node: int, request: bytes, now_ns: int) -> None:
        server = self._node(node)
        receiving = server.receiving
        opens = not receiving and _opens(request)
        if opens:
            self.recorder.add(
                RequestSeen(now_ns, MASTER, bytes((node,)) + request, frame=str(CanFrame(SDO_REQUEST + node, request)))
            )
            self._memory = self._begun(node, request, now_ns)
            server.objects.word = self._word_for(self._memory is not None)
        elif not receiving and request[0] & 0xE3 == _BLOCK_ACKNOWLEDGED:
            self.recorder.add(Sent(now_ns, MASTER, (SDO_REQUEST + node).to_bytes(2, "big") + request))
        if self._muted == "all" or (receiving and self._missed(request)):
            self.last_ns = now_ns
            return
        true = (*server.answer(request, now_ns), *(self._early(server, now_ns) if receiving else ()))
        case = self._playing
        if case is None or self._memory is None or not true:
            self._send([SendFrame(CanFrame(0x580 + node, d), good=True) for d in true], now_ns)
            return
        poison = self._words[2]
        scene = SdoRequestContext(
            node, request, true, server.poisoned(request, poison), poison.to_bytes(self._size, "little"), opens,
            self.struck - 1, self.timeout_s, self._memory,
        )  # fmt: skip
        self.last_ns = now_ns
        self._send(case.play(scene), now_ns)

    def _missed(self, segment: bytes) -> bool:
        """Return whether the test case makes the node ignore this segment of a block download, as if it were lost."""
        case, memory = self._playing, self._memory
        if case is None or memory is None or not (case.misses or case.early):
            return False
        if memory.get("deaf") and segment[0] & 0x7F != 1:
            return True  # this segment belongs to the rest of a sub-block that was acknowledged early
        memory["deaf"] = 0
        memory["segments"] = memory.get("segments", 0) + 1
        return memory["segments"] == case.misses

    def _early(self, server: HonestNode, now_ns: int) -> list[bytes]:
        """Return the acknowledgement that the test case sends before the end of a sub-block; empty if none is due after
        this segment.
        """
        case, memory = self._playing, self._memory
        if case is None or memory is None or not case.early or memory.get("segments") != case.early:
            return []
        memory["deaf"] = 1
        return server.acknowledge(now_ns)

    def _word_for(self, played: bool) -> int:
        """Return the value that the objects hold during a transfer; `played` tells whether the transfer belongs to the test
        case.

        In a test case whose faulty frames carry the new correct value (`holds_good`), all other transfers still carry the
        previous value, so that the client can know the new value only from the faulty frames.
        """
        if self._case is not None and self._case.holds_good and not played:
            return self._words[1] if self._word == self._words[0] else self._words[0]
        return self._word

    def _begun(self, node: int, request: bytes, now_ns: int) -> dict[str, int] | None:
        """Begin a transfer.

        If the transfer belongs to the test case, return the memory for its replies, which lasts until the transfer ends;
        otherwise return None.
        """
        self._playing = case = self._case
        if case is None or self.struck >= self.strikes:
            return None
        if request[0] >> 5 != _WANTED.get(case.wants):
            return None
        if case.mutes:
            self._muted = case.mutes
            self.pending += 1
            self._nursery.start(self._unmute(case, node), "silence")
        if case.beat_late_s:
            self._beat_late_s = case.beat_late_s
            self.pending += 1
        self.first_ns = self.first_ns or now_ns
        self.struck += 1
        return {"word": self._word, "mux": int.from_bytes(request[1:4], "little")}

    async def _unmute(self, case: CanopenCase, number: int) -> None:
        node = self._node(number)
        before = node.state
        if case.mutes == "sdo":
            node.command(STOP)
        await asyncio.sleep(case.mute_s)
        self._muted = ""
        if case.mutes == "sdo" and node.state == STOPPED:
            node.state = before
        if case.boots:
            node.command(RESET_COMMUNICATION)
            await self._connection.send(CanFrame(HEARTBEAT + number, bytes((BOOT_UP,))))
        self.last_ns = self.now_ns()
        self.pending -= 1

    def _send(self, steps: list[SendFrame], now_ns: int) -> None:
        """Send frames in order; correct answers wait until pending faulty ones were sent."""
        if not steps:
            return
        start_ns = now_ns
        if self._free_ns > now_ns and any(m.good for m in steps):
            start_ns = self._free_ns + round(BEHIND_S * NS_PER_S)
        timed = [(start_ns + round(m.after_s * NS_PER_S), m) for m in steps]
        self._free_ns = max([self._free_ns, *(t for t, m in timed if not m.good)])
        self.pending += len(timed)
        self._nursery.start(self._make(timed), "frames")

    async def _make(self, timed: list[tuple[int, SendFrame]]) -> None:
        left = len(timed)
        try:
            for t_ns, step in timed:
                if (wait_ns := t_ns - self.now_ns()) > 0:
                    await asyncio.sleep(wait_ns / NS_PER_S)
                now_ns = self.now_ns()
                if not step.good:
                    self.last_ns = now_ns
                self.recorder.add(ReplySent(now_ns, MASTER, step.frame.data, step.good, frame=str(step.frame)))
                await self._connection.send(step.frame)
                left -= 1
                self.pending -= 1
        except ConnectionLost:
            pass  # the bus is lost, which `serve` reports
        finally:
            self.pending -= left

    # -- nodes ----------------------------------------------------------------------------------------------------

    def _born(self) -> HonestNode:
        return HonestNode(self._word, self._size, self._held)

    def _node(self, node: int) -> HonestNode:
        if node not in self._nodes:
            self._nodes[node] = self._born()
        return self._nodes[node]

    async def _commanded(self, specifier: int, addressed: int) -> None:
        if 1 <= addressed <= 127:
            self._node(addressed)
        for number, node in list(self._nodes.items()):
            if addressed in (0, number) and node.command(specifier):
                await self._connection.send(CanFrame(HEARTBEAT + number, bytes((BOOT_UP,))))

    async def _guard(self, number: int, now_ns: int) -> None:
        """Answer a guard request (CiA 301, 7.2.8.2.2.1) with the state and an alternating toggle bit.

        In the case about guard requests the toggle bit is wrong.
        """
        self.recorder.add(Sent(now_ns, MASTER, (HEARTBEAT + number).to_bytes(2, "big")))
        node, case = self._node(number), self._case
        toggle = self._guarded.get(number, 0)
        if case is not None and case.wants == "guard request" and self.struck < self.strikes:
            self.first_ns, self.last_ns = self.first_ns or now_ns, now_ns
            self.struck += 1
            toggle ^= TOGGLE
        if self._muted in ("heartbeat", "all"):
            return
        self._guarded[number] = toggle ^ TOGGLE
        await self._connection.send(CanFrame(HEARTBEAT + number, bytes((node.state | toggle,))))

    async def _live(self) -> None:
        while True:
            await asyncio.sleep(self._heartbeat_s)
            if self._beat_late_s:
                late_s, self._beat_late_s = self._beat_late_s, 0.0
                await asyncio.sleep(late_s)
                self.last_ns = self.now_ns()
                self.pending -= 1
            if self._muted in ("heartbeat", "all"):
                continue
            for number, node in list(self._nodes.items()):
                if number not in self._guarded:  # a guarded node sends no heartbeat
                    await self._connection.send(CanFrame(HEARTBEAT + number, bytes((node.state,))))


def _opens(request: bytes) -> bool:
    """Return whether a request begins an SDO transfer on which a test case may act."""
    command = request[0] >> 5
    if command == BLOCK_UPLOAD:
        return request[0] & 3 == 0
    return command in (UPLOAD, DOWNLOAD) or (command == BLOCK_DOWNLOAD and request[0] & 1 == 0)
