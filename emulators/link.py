"""A serial line carried over TCP: the emulated connection between a device and its driver, independent of both.

It connects a virtual serial port and a TCP stream (``fieldtwin link PTY tcp://HOST:PORT``), like ``socat
pty,raw,echo=0,link=PTY tcp:HOST:PORT``, and interoperates with socat on either side. Bytes pass unchanged, in order and
exactly once while the TCP connection (the carrier) exists. Without it, bytes sent on the line are lost and counted, as
on a cable that is cut: if a request were kept and delivered later, it would be executed long after its sender had
abandoned it.

This module must never depend on a protocol: it does not evaluate frames, unit IDs or the timeouts of requests.
"""

from __future__ import annotations

import asyncio
import contextlib
from abc import ABC, abstractmethod
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass
from pathlib import Path

from fieldtwin.emulators.endpoints.faulty.streams import FaultyEnd
from fieldtwin.emulators.endpoints.link_ends import TcpAcceptor, TcpEnd, TtyEnd
from fieldtwin.emulators.endpoints.pty import PtyEnd
from fieldtwin.emulators.faults.engine import WireFaults
from fieldtwin.gateway.core.connection import PROTOCOL, ByteConnection, TCPConnection
from fieldtwin.gateway.core.endpoint import SOCKET_SCHEMES, Endpoint
from fieldtwin.gateway.core.errors import Bug, FieldtwinError, Unreachable, UsageError

CARRIERS = ("tcp", "rtu+tcp")


@dataclass(frozen=True, slots=True)
class LinkOptions:
    """The behaviour of a link when its carrier fails."""

    connect_timeout_s: float = 5.0
    backoff_s: float = 0.1
    """First wait before a retry; it doubles up to `backoff_max_s`, and starts over after a session of `proven_after_s`."""
    backoff_max_s: float = 5.0
    proven_after_s: float = 1.0
    half_close_s: float = 0.5
    """The time in seconds for which a side that finished sending may still receive (socat -t)."""
    stall_s: float = 2.0
    """The time in seconds, beyond the transmission time, that the link waits for a serial line that accepts no bytes. Then the
    bytes are lost.
    """


class EmulatedConnection(TCPConnection):
    """A connection that is always of type TCP and also stores the original PROTOCOL (the paper's schema EmulatedConnection).

    `emulate_write` and `emulate_read` return the bytes unchanged, and count them.
    """

    def __init__(self, protocol: PROTOCOL) -> None:
        if protocol is PROTOCOL.CAN:
            raise Bug("CAN is a bus, not a pipe", expected="a software CAN bus (paper.md, ruling 13)")
        super().__init__()
        self.protocol = protocol
        self.written_bytes = 0
        self.read_bytes = 0
        self.dropped_write_bytes = 0
        """The number of bytes from the near side that were lost, because there was no carrier or it was lost while they were
        sent.
        """
        self.dropped_read_bytes = 0
        """The number of bytes from the far side that were lost because the near side did not accept them."""

    def emulate_write(self, data: bytes) -> bytes:
        """Pass outgoing bytes from the near side to the carrier unchanged."""
        self.written_bytes += len(data)
        return data

    def emulate_read(self, data: bytes) -> bytes:
        """Pass incoming bytes from the carrier to the near side unchanged."""
        self.read_bytes += len(data)
        return data


class _Plug(ABC):
    """A side of the link, which is prepared once and connected for each session."""

    stays: bool
    """Whether this side stays open between sessions: a serial port remains when the TCP connection (the carrier) is lost."""

    def __init__(self, endpoint: Endpoint) -> None:
        self.endpoint = endpoint
        self.connection: ByteConnection | None = None

    async def prepare(self) -> None:  # noqa: B027  not abstract: most sides have nothing to prepare
        """Open the port or the listener of this side, before the link runs; raises `FieldtwinError` if that fails."""

    @abstractmethod
    async def connect(self) -> ByteConnection:
        """Return the connection of this session; raises `Unreachable`."""

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
    door: TcpAcceptor | None = None

    async def prepare(self) -> None:
        self.door = await TcpAcceptor.open(self.endpoint)
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


class EmulatedLink:
    """A running emulated connection between `near` and `far`.

    ``near -> far`` is `EmulatedConnection.emulate_write`, ``far -> near`` is `emulate_read`. At least one end is TCP,
    unless there are `faults`: then two serial ports of this computer are permitted, with the Modbus client at the near one.
    `on_event` is called with a line for the user when the carrier connects, disconnects, or cannot be reached.
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
        """The number of times that the carrier was connected."""
        self.failed_attempts = 0
        """The number of failed attempts to connect the carrier."""
        self.connected = False
        self._on_event = on_event
        self._last_event = ""

    @property
    def ends(self) -> tuple[Endpoint, Endpoint]:
        """Return the near and the far endpoint, with the real port of an end that listens."""
        return self._near.endpoint, self._far.endpoint

    async def open(self) -> None:
        """Create the virtual serial port and the listener, as far as the endpoints need them; raises if that fails."""
        try:
            await self._near.prepare()
            await self._far.prepare()
        except BaseException:
            await self.aclose()
            raise

    async def serve(self) -> None:
        """Forward until cancelled, reconnecting with back-off whenever the carrier is lost."""
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
        """Return the counters since the start."""
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
        """Connect both sides: serial ports first, then incoming connections, and outgoing connections last."""
        order = sorted((self._near, self._far), key=lambda plug: (not plug.stays, isinstance(plug, _DialPlug)))
        first = await order[0].connect()
        async with self._line_cut():
            second = await order[1].connect()
        return (first, second) if order[0] is self._near else (second, first)

    @contextlib.asynccontextmanager
    async def _line_cut(self) -> AsyncIterator[None]:
        """Drop and count the bytes from a serial side while there is no carrier."""
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
            with contextlib.suppress(Unreachable):  # the side is lost; the next connect detects it
                self._dropped(plug is self._near, len(await connection.read()))

    async def _session(self, near: ByteConnection, far: ByteConnection) -> str:
        """Forward in both directions until one side ends; return the reason."""
        masters, devices = near, far
        behind: FaultyEnd | None = None
        if self._faults is not None:  # the end with the clients: a port created here, or the listener
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
            # the other direction continues if a side still receives, or if bytes of a lost side are still here
            if still and (finished or target.lost is not None):
                await asyncio.wait((other,), timeout=self.options.half_close_s)
            return str(ended.result())
        finally:
            if behind is not None:
                behind.detach()
            await _cancel(outward, inward)

    async def _pump(self, source: ByteConnection, target: ByteConnection, outward: bool) -> FieldtwinError:
        """Forward one direction and return the reason why it ended.

        It forwards one chunk at a time, so that a slow receiver holds the sender back."""
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
                self._event(f"no program reads the bytes on {target.endpoint}: {len(data)} lost")
            except Unreachable as e:
                return e
            finally:
                if not delivered:
                    self._dropped(outward, len(data))

    def _patience_s(self, target: ByteConnection, nbytes: int) -> float | None:
        """Return the time limit in seconds for a write; None for TCP, whose flow control holds the sender back."""
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
        if self._on_event is not None and text != self._last_event:  # a repeated event is reported once
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
    on_ready: Callable[[EmulatedLink], None] | None = None,
    faults: WireFaults | None = None,
) -> None:
    """Run a link until cancelled. `on_ready` is called once its port and its listener exist. `faults` change the forwarded bytes.

    Raises `UsageError` for endpoints that cannot be linked, `EndpointBusy` if the port to listen on is taken. A far
    side that cannot be reached yet is not an error: the link retries.
    """
    link = EmulatedLink(near, far, options, on_event, faults)
    await link.open()
    try:
        if on_ready is not None:
            on_ready(link)
        await link.serve()
    finally:
        await link.aclose()
