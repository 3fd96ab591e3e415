"""The EmulatedConnection: a wire that is carried over TCP, belonging neither to the device nor to its driver.

A virtual serial port here and a TCP stream there (``fieldtwin link PTY tcp://HOST:PORT``), as ``socat
pty,raw,echo=0,link=PTY tcp:HOST:PORT`` does it, and interoperable with that on either side. Bytes pass unchanged, in
order and exactly once while the carrier stands. While it does not, what is said on the line is lost and counted, as on
a cable that is cut: kept and delivered later, a request would be executed long after its sender gave it up.

It must never know a protocol: no frame, no unit, no time-out of a request.
"""

from __future__ import annotations

import asyncio
import contextlib
from abc import ABC, abstractmethod
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass
from pathlib import Path

from fieldtwin.emulators.endpoints.faulty import FaultyEnd
from fieldtwin.emulators.endpoints.link_ends import TcpDoor, TcpEnd, TtyEnd
from fieldtwin.emulators.endpoints.pty import PtyEnd
from fieldtwin.emulators.faults.engine import WireFaults
from fieldtwin.gateway.core.connection import PROTOCOL, ByteConnection, TCPConnection
from fieldtwin.gateway.core.endpoint import SOCKET_SCHEMES, Endpoint
from fieldtwin.gateway.core.errors import Bug, FieldtwinError, Unreachable, UsageError

CARRIERS = ("tcp", "rtu+tcp")


@dataclass(frozen=True, slots=True)
class LinkOptions:
    """How a link behaves when its carrier does not."""

    connect_timeout_s: float = 5.0
    backoff_s: float = 0.1
    """First wait before trying again; doubles up to `backoff_max_s`, starts over once a session proved itself."""
    backoff_max_s: float = 5.0
    proven_after_s: float = 1.0
    half_close_s: float = 0.5
    """How long a side that finished sending may still receive (socat -t)."""
    stall_s: float = 2.0
    """How long a serial line that takes no bytes is waited for, beyond its wire time; then they are lost."""


class EmulatedConnection(TCPConnection):
    """SPEC row EmulatedConnection: a Connection, of type TCP for its whole life, that knows the original protocol.

    `emulate_write` and `emulate_read` are the identity: what comes in goes out, byte for byte. They count.
    """

    def __init__(self, protocol: PROTOCOL) -> None:
        if protocol is PROTOCOL.CAN:
            raise Bug("CAN is a bus and no pipe", expected="a software CAN bus (SPEC ruling 13)")
        super().__init__()
        self.protocol = protocol
        self.written_bytes = 0
        self.read_bytes = 0
        self.dropped_write_bytes = 0
        """Bytes of the near side that were lost: no carrier, or it broke with them."""
        self.dropped_read_bytes = 0
        """Bytes of the far side that were lost: the near side did not take them."""

    def emulate_write(self, data: bytes) -> bytes:
        """Outgoing, from the near side to the carrier: the same bytes."""
        self.written_bytes += len(data)
        return data

    def emulate_read(self, data: bytes) -> bytes:
        """Incoming, from the carrier to the near side: the same bytes."""
        self.read_bytes += len(data)
        return data


class _Plug(ABC):
    """A side of the link: how it is prepared once and connected again and again."""

    stays: bool
    """Open across sessions: a serial port does not go away because the carrier did."""

    def __init__(self, endpoint: Endpoint) -> None:
        self.endpoint = endpoint
        self.connection: ByteConnection | None = None

    async def prepare(self) -> None:  # noqa: B027  not abstract: most sides have nothing to prepare
        """What must succeed before anything runs; raises when it does not."""

    @abstractmethod
    async def connect(self) -> ByteConnection:
        """The connection of this session; raises `Unreachable`."""

    async def disconnect(self) -> None:
        if self.connection is not None:
            await self.connection.aclose()
            self.connection = None

    async def aclose(self) -> None:
        await self.disconnect()

    @property
    def open_now(self) -> ByteConnection | None:
        return self.connection if self.connection is not None and self.connection.lost is None else None


class _PtyPlug(_Plug):
    stays = True

    async def prepare(self) -> None:
        pace = self.endpoint.serial if self.endpoint.param("pace") == "true" else None
        self.connection = await PtyEnd.open(Path(self.endpoint.path), self.endpoint, pace)

    async def connect(self) -> ByteConnection:
        if self.open_now is None:
            await self.disconnect()
            await self.prepare()
        assert self.connection is not None
        return self.connection


class _TtyPlug(_Plug):
    stays = True

    async def connect(self) -> ByteConnection:
        if self.open_now is None:
            await self.disconnect()
            self.connection = TtyEnd.open(self.endpoint)
        assert self.connection is not None
        return self.connection


class _DialPlug(_Plug):
    stays = False

    def __init__(self, endpoint: Endpoint, timeout_s: float) -> None:
        super().__init__(endpoint)
        self._timeout_s = timeout_s

    async def connect(self) -> ByteConnection:
        self.connection = await TcpEnd.dial(self.endpoint, self._timeout_s)
        return self.connection


class _DoorPlug(_Plug):
    stays = False
    door: TcpDoor | None = None

    async def prepare(self) -> None:
        self.door = await TcpDoor.open(self.endpoint)
        self.endpoint = self.door.bound

    async def connect(self) -> ByteConnection:
        assert self.door is not None
        self.connection = await self.door.next_peer()
        return self.connection

    async def aclose(self) -> None:
        await super().aclose()
        if self.door is not None:
            await self.door.aclose()


def _plug(endpoint: Endpoint, options: LinkOptions) -> _Plug:
    if endpoint.scheme == "pty":
        return _PtyPlug(endpoint)
    if endpoint.is_serial:
        return _TtyPlug(endpoint)
    if endpoint.scheme in CARRIERS:
        if endpoint.param("listen") in ("1", "true"):
            return _DoorPlug(endpoint)
        return _DialPlug(endpoint, options.connect_timeout_s)
    raise UsageError(
        f"{endpoint} cannot be an end of a link",
        expected="pty:PATH, rtu:DEVICE, tcp://HOST:PORT, tcp://HOST:PORT?listen=1",
    )


class Link:
    """An emulated connection between `near` and `far`, running.

    ``near -> far`` is `EmulatedConnection.emulate_write`, ``far -> near`` is `emulate_read`. At least one end is TCP, except
    where there are `faults`: then two serial ports of this computer will do, with the masters at the near one.
    `on_event` is told, in a line for a person, when the carrier comes, goes, or cannot be had.
    """

    def __init__(
        self,
        near: Endpoint,
        far: Endpoint,
        options: LinkOptions | None = None,
        on_event: Callable[[str], None] | None = None,
        faults: WireFaults | None = None,
    ) -> None:
        self._faults = faults
        self.options = options or LinkOptions()
        self._near, self._far = _plug(near, self.options), _plug(far, self.options)
        self._serial_only = near.scheme not in SOCKET_SCHEMES and far.scheme not in SOCKET_SCHEMES
        if self._serial_only and faults is None:
            raise UsageError(
                f"{near} and {far}: a link is carried over TCP", expected="at least one tcp://HOST:PORT, or --faults"
            )
        serial = self._near.stays or self._far.stays
        self.connection = EmulatedConnection(PROTOCOL.RS232 if serial else PROTOCOL.TCP)
        self.sessions = 0
        """How often the carrier came up."""
        self.failed_attempts = 0
        """How often it could not be had."""
        self.connected = False
        self._on_event = on_event
        self._last_event = ""

    @property
    def ends(self) -> tuple[Endpoint, Endpoint]:
        """Near and far, with the real port where it listens."""
        return self._near.endpoint, self._far.endpoint

    async def open(self) -> None:
        """Make the virtual serial port and listen, whatever this link has of them; raises when that fails."""
        try:
            await self._near.prepare()
            await self._far.prepare()
        except BaseException:
            await self.aclose()
            raise

    async def serve(self) -> None:
        """Forward until cancelled, connecting again with back-off whenever the carrier is gone."""
        loop = asyncio.get_running_loop()
        wait_s = self.options.backoff_s
        while True:
            try:
                near, far = await self._connect()
                began_s = loop.time()
                self.sessions += 1
                self.connected = True
                self._event(f"connected: {self._near.endpoint} <-> {self._far.endpoint}")
                self._event(f"disconnected: {await self._session(near, far)}")
                if loop.time() - began_s >= self.options.proven_after_s:
                    wait_s = self.options.backoff_s
            except Unreachable as e:
                self.failed_attempts += 1
                self._event(f"waiting: {e}")
            finally:
                self.connected = False
                for plug in (self._near, self._far):
                    if not plug.stays and plug.connection is not None:
                        self._dropped(plug is self._near, len(plug.connection.read_pending()))
                        await plug.disconnect()
            async with self._line_cut():
                await asyncio.sleep(wait_s)
            wait_s = min(wait_s * 2, self.options.backoff_max_s)

    async def aclose(self) -> None:
        """Close both ends. Closing twice does nothing."""
        await self._near.aclose()
        await self._far.aclose()

    def stats(self) -> dict[str, int]:
        """Counters since the start."""
        c = self.connection
        return {
            "sessions": self.sessions,
            "failed_attempts": self.failed_attempts,
            "written_bytes": c.written_bytes,
            "read_bytes": c.read_bytes,
            "dropped_write_bytes": c.dropped_write_bytes,
            "dropped_read_bytes": c.dropped_read_bytes,
        }

    async def _connect(self) -> tuple[ByteConnection, ByteConnection]:
        """Serial ports first, then whoever comes to us, and only then is anybody dialled."""
        order = sorted((self._near, self._far), key=lambda plug: (not plug.stays, isinstance(plug, _DialPlug)))
        first = await order[0].connect()
        async with self._line_cut():
            second = await order[1].connect()
        return (first, second) if order[0] is self._near else (second, first)

    @contextlib.asynccontextmanager
    async def _line_cut(self) -> AsyncIterator[None]:
        """While there is no carrier, what a serial side says is lost, and counted."""
        tasks = []
        for plug in (self._near, self._far):
            if plug.stays and plug.open_now is not None:
                tasks.append(asyncio.create_task(self._discard(plug)))
        try:
            yield
        finally:
            await _cancel(*tasks)

    async def _discard(self, plug: _Plug) -> None:
        while (connection := plug.open_now) is not None:
            with contextlib.suppress(Unreachable):  # lost: the next connect sees it
                self._dropped(plug is self._near, len(await connection.read()))

    async def _session(self, near: ByteConnection, far: ByteConnection) -> str:
        """Forward both ways until one side ends; why it did."""
        masters, devices = near, far
        behind: FaultyEnd | None = None
        if self._faults is not None:  # the end at which masters ask: a port that was made, or where we listen
            asked_at_far = isinstance(self._far, _PtyPlug | _DoorPlug) and not self._serial_only
            behind = FaultyEnd(far if asked_at_far else near, self._faults)
            masters, devices = (behind, far) if behind.inner is near else (near, behind)
        outward = asyncio.create_task(self._pump(masters, devices, outward=True))
        inward = asyncio.create_task(self._pump(devices, masters, outward=False))
        try:
            done, still = await asyncio.wait((outward, inward), return_when=asyncio.FIRST_COMPLETED)
            ended, other, target = (outward, inward, far) if outward in done else (inward, outward, near)
            source = near if ended is outward else far
            finished = isinstance(source, TcpEnd) and source.half_closed
            if finished and isinstance(target, TcpEnd):
                target.finish()
            # the other direction goes on where a side still listens, or where bytes of a side that is gone are here
            if still and (finished or target.lost is not None):
                await asyncio.wait((other,), timeout=self.options.half_close_s)
            return str(ended.result())
        finally:
            if behind is not None:
                behind.detach()
            await _cancel(outward, inward)

    async def _pump(self, source: ByteConnection, target: ByteConnection, outward: bool) -> FieldtwinError:
        """One direction, a chunk at a time, so that a slow side holds the other back. Returns why it ended."""
        forward = self.connection.emulate_write if outward else self.connection.emulate_read
        while True:
            try:
                data = forward(await source.read())
            except Unreachable as e:
                return e
            delivered = False
            try:
                async with asyncio.timeout(self._patience_s(target, len(data))):
                    await target.write(data)
                delivered = True
            except TimeoutError:
                self._event(f"nobody takes the bytes on {target.endpoint}: {len(data)} lost")
            except Unreachable as e:
                return e
            finally:
                if not delivered:
                    self._dropped(outward, len(data))

    def _patience_s(self, target: ByteConnection, nbytes: int) -> float | None:
        """TCP holds back its sender for as long as it takes; a serial line waits for nobody."""
        if isinstance(target, FaultyEnd):
            target = target.inner
        if isinstance(target, TcpEnd):
            return None
        return self.options.stall_s + nbytes * target.endpoint.serial.char_time_s

    def _dropped(self, outward: bool, nbytes: int) -> None:
        if outward:
            self.connection.dropped_write_bytes += nbytes
        else:
            self.connection.dropped_read_bytes += nbytes

    def _event(self, text: str) -> None:
        if self._on_event is not None and text != self._last_event:  # the same refusal every 5 s is said once
            self._last_event = text
            self._on_event(text)


async def _cancel(*tasks: asyncio.Task[FieldtwinError] | asyncio.Task[None]) -> None:
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)


async def run_link(
    near: Endpoint,
    far: Endpoint,
    options: LinkOptions | None = None,
    *,
    on_event: Callable[[str], None] | None = None,
    on_ready: Callable[[Link], None] | None = None,
    faults: WireFaults | None = None,
) -> None:
    """Run a link until cancelled. `on_ready` is called once its port and its listener exist. `faults` strike what passes.

    Raises `UsageError` for endpoints that cannot be linked, `EndpointBusy` when the port to listen on is taken.
    A far side that is not there yet is no error: it is tried again.
    """
    link = Link(near, far, options, on_event, faults)
    await link.open()
    try:
        if on_ready is not None:
            on_ready(link)
        await link.serve()
    finally:
        await link.aclose()
