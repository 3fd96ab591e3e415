"""The simulated Modbus server to which a client under test connects. It replies correctly until a test case begins.

It records all requests and replies, and gives no verdict. It handles connections and time, and does not depend on specific
cases.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping

from fieldtwin.conformance.clients.modbus.device import (
    READS,
    REGISTER_READS,
    WRITES,
    AsciiWire,
    HonestDevice,
    MbapWire,
    ModbusWire,
    RtuWire,
)
from fieldtwin.conformance.clients.modbus.setup import (
    GoSilent,
    HangUp,
    ModbusCase,
    RequestContext,
    SendBytes,
    ServerStep,
    Unplug,
)
from fieldtwin.conformance.clients.recorder import Recorder
from fieldtwin.conformance.core.observation import Garbled, Left, ObservedConnection, ReplySent, RequestSeen, Word
from fieldtwin.emulators.endpoints.socket_end import SocketEnd
from fieldtwin.emulators.modbus.bank import Table
from fieldtwin.emulators.virtual.memory_stream import MemoryEnd
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.connection import ByteConnection
from fieldtwin.gateway.core.errors import ConnectionLost

BEHIND_S = 0.050
"""Minimum time in seconds between a faulty answer and the next correct one."""
LINE_GAP_S = 0.060
"""Pause in seconds that ends a frame on a serial line; an incomplete frame then counts as garbage."""


class HostileServer:
    """The Modbus server for all clients of an endpoint. `play` is the current case; None: all requests are answered
    correctly.

    `struck` counts wrong replies of the case, `first_ns` is the time of the first one, `last_ns` that of the last fault;
    `pending` is the number of steps that are scheduled but not yet executed.
    """

    def __init__(
        self, make_wire: Callable[[], ModbusWire], words: tuple[int, int, int], held: Mapping[tuple[Table, int], int]
    ) -> None:
        self.recorder = Recorder()
        self.first_word, self.second_word, self.poison = words
        self.device = HonestDevice(self.first_word, held)
        self.play: ModbusCase | None = None
        self.timeout_s = 1.0
        self.strikes = self.struck = self.first_ns = self.last_ns = self.pending = 0
        self.clients = 0
        self.on_event: Callable[[], None] = lambda: None
        self.unplug: Callable[[Unplug], None] = lambda step: None
        """The function that removes the port and restores it. Until the port is restored, `pending` counts this step."""
        self._make_wire = make_wire
        self._first: RequestContext | None = None
        self._loop = asyncio.get_running_loop()

    def now_ns(self) -> int:
        return round(self._loop.time() * NS_PER_S)

    def hold(self, word: Word) -> int:
        """Let all registers and bits hold the correct value that `word` names, from now on; return this value."""
        self.device.word = self.first_word if word is Word.FIRST else self.second_word
        return self.device.word

    def begin(self, case: ModbusCase, strikes: int) -> None:
        """Run `case` from the next matching request on, until it has answered `strikes` requests wrongly or `end` is called."""
        self.play, self.strikes, self._first = case, strikes, None
        self.struck = self.first_ns = self.last_ns = 0

    def end(self) -> None:
        """Answer all requests correctly from now on; steps in progress are completed."""
        self.play = None

    async def serve(self, connection: ByteConnection, *, plugged_in_again: bool = False) -> None:
        """Serve one client until it disconnects. `plugged_in_again`: the connection is a port that a case had removed."""
        self.clients += 1
        number, wire = self.clients, self._make_wire()
        client = _Client(self, connection, wire, number)
        self.note(ObservedConnection(self.now_ns(), number, plugged_in_again))
        try:
            async with Nursery() as nursery:
                client.nursery = nursery
                await client.read()
        except ConnectionLost:
            pass
        finally:
            self.note(Left(self.now_ns(), number, client.hung_up))

    def note(self, event: RequestSeen | ReplySent | Garbled | ObservedConnection | Left) -> None:
        self.recorder.add(event)
        self.on_event()

    def steps(self, wire: ModbusWire, request: bytes, tag: int, now_ns: int) -> list[ServerStep]:
        """Return the steps for a request received at `now_ns`: those of a correct reply, or those of the test case."""
        true = self.device.answer(request[1:], now_ns)
        case = self.play
        if request[0] == 0 and not isinstance(wire, MbapWire):
            return []  # a broadcast is not answered
        honest: list[ServerStep] = [SendBytes(wire.frame(request, tag, true), good=True)] if true else []
        if case is None or self.struck >= self.strikes or not true or not _wanted(case, request):
            return honest
        false = self.device.answer_with(self.poison, request[1:], now_ns) if request[1] in READS else true
        scene = RequestContext(wire, request, tag, true, false, self.struck, self.timeout_s, self._first)
        made = case.play(scene)
        self._first = self._first or scene
        self.struck += 1
        self.first_ns = self.first_ns or now_ns
        self.last_ns = now_ns
        return made


def _wanted(case: ModbusCase, request: bytes) -> bool:
    function = request[1]
    if case.wants == "request to unit 0":
        return request[0] == 0
    if case.wants == "register read":
        return function in REGISTER_READS
    if case.wants == "read of several":
        return function in REGISTER_READS and int.from_bytes(request[4:6], "big") > 1
    return function in (READS if case.wants == "read" else WRITES if case.wants == "write" else ())


class _Client:
    nursery: Nursery

    def __init__(self, stage: HostileServer, connection: ByteConnection, wire: ModbusWire, number: int) -> None:
        self.hung_up = False
        self._deaf = False
        self._stage = stage
        self._connection = connection
        self._wire = wire
        self._number = number
        self._free_ns = 0
        self._dirty = False

    async def read(self) -> None:
        while True:
            data = await self._next()
            now_ns = self._stage.now_ns()
            for request, tag in self._wire.cut(data, now_ns):
                frame = self._wire.frame(request, tag, request[1:])
                self._stage.note(RequestSeen(now_ns, self._number, request, tag, frame.hex(" ")))
                if self._deaf:
                    continue
                self._answer(self._stage.steps(self._wire, request, tag, now_ns), now_ns)
            self._dirty = bool(data)
            if garbage := self._wire.garbage():
                self._stage.note(Garbled(now_ns, self._number, data[-garbage:]))

    async def _next(self) -> bytes:
        """Return the next bytes; on a serial line return b'' after a pause of `LINE_GAP_S`, which ends an incomplete frame."""
        if not self._dirty or isinstance(self._wire, MbapWire):
            return await self._connection.read()
        try:
            async with asyncio.timeout(LINE_GAP_S):
                return await self._connection.read()
        except TimeoutError:
            return b""

    def _answer(self, steps: list[ServerStep], now_ns: int) -> None:
        """Schedule steps in order; correct answers wait until pending faulty ones were sent, as a real device would."""
        start_ns = now_ns
        if self._free_ns > now_ns and any(isinstance(m, SendBytes) and m.good for m in steps):
            start_ns = self._free_ns + round(BEHIND_S * NS_PER_S)
        timed = [(start_ns + round(step.after_s * NS_PER_S), step) for step in steps]
        odd = [t for t, step in timed if not (isinstance(step, SendBytes) and step.good)]
        self._free_ns = max([self._free_ns, *odd])
        if not timed:
            return
        self._stage.pending += len(timed)
        self.nursery.start(self._make(timed, now_ns), "steps")

    async def _make(self, timed: list[tuple[int, ServerStep]], asked_ns: int) -> None:
        left = len(timed)
        try:
            for t_ns, step in timed:
                if (wait_ns := t_ns - self._stage.now_ns()) > 0:
                    await asyncio.sleep(wait_ns / NS_PER_S)
                await self._do(step, asked_ns)
                left -= 1
                self._stage.pending -= 1
        except ConnectionLost:
            pass  # the client closed the connection before it received its answer
        finally:
            self._stage.pending -= left
            self._stage.on_event()

    async def _do(self, step: ServerStep, asked_ns: int) -> None:
        now_ns = self._stage.now_ns()
        if self._deaf:
            return
        if isinstance(step, GoSilent):
            self._stage.last_ns = now_ns
            self._deaf = True
            return
        if isinstance(step, Unplug):
            self.hung_up = True
            self._stage.unplug(step)
            return
        if isinstance(step, HangUp):
            self._stage.last_ns = now_ns
            self.hung_up = True
            await _hang_up(self._connection, reset=step.reset)
            return
        if not step.good:
            self._stage.last_ns = now_ns
        self._stage.note(ReplySent(now_ns, self._number, step.data, step.good, asked_ns))
        await self._connection.write(step.data)


async def _hang_up(connection: ByteConnection, *, reset: bool) -> None:
    if isinstance(connection, SocketEnd) and reset:
        connection.evict(reset=True)
    elif isinstance(connection, MemoryEnd) and reset:
        connection.wire.cut(ConnectionLost("the connection was reset", where=str(connection.endpoint)))
    else:
        await connection.aclose()


def wire_for(scheme: str) -> Callable[[], ModbusWire]:
    """Return the framing of an endpoint of `scheme`."""
    return MbapWire if scheme == "tcp" else AsciiWire if scheme == "ascii" else RtuWire


def traits(scheme: str) -> frozenset[str]:
    """Return the features that a case may need: ``rtu``, ``ascii`` or ``tcp``, and ``stream`` if it can be closed."""
    if scheme == "rtu+tcp":
        return frozenset({"rtu", "stream"})
    return frozenset({"tcp", "stream"}) if scheme == "tcp" else frozenset({scheme})
