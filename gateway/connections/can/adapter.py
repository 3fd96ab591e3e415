"""A CAN adapter of any kind that python-can supports: PCAN, Kvaser, slcan, gs_usb, IXXAT, Vector, its virtual bus...

Endpoints use python-can's own names, ``can:INTERFACE/CHANNEL``: ``can:pcan/PCAN_USBBUS1?bitrate=250000``,
``can:kvaser/0``, ``can:slcan//dev/ttyACM0@115200``. The adapter's driver is imported when the adapter is opened, so only
computers that use such an adapter need the driver. A thread reads from the driver, because few drivers have a descriptor that
an event loop could watch.

This module does not interpret frames.
"""

from __future__ import annotations

import asyncio
import threading
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import can

from fieldtwin.gateway.connections.can.message import message_of
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.connection import CANConnection, CanConnection, closed_locally
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import ConnectionLost, Desync, EndpointBusy, Unreachable, UsageError, WireError
from fieldtwin.gateway.wallclock import WallClock

POLL_S = 0.05
"""The time that the reading thread waits in the driver; closing takes up to this long."""

SEND_TIMEOUT_S = 2.0

_OWN = frozenset({"bitrate", "listen"})
"""Parameters of the endpoint that this module reads; all others are passed to the driver (``?app_name=CANalyzer``)."""

RATELESS = frozenset({"virtual", "udp_multicast"})
"""Interfaces of python-can that have no bit rate."""


class AdapterConnection(CanConnection):
    """An open CAN adapter; create it with `open`. `bitrate` is the adapter's setting in bit/s, or 0 if it has none."""

    def __init__(self, endpoint: Endpoint, bus: can.BusABC, bitrate: int = 0, max_pending: int = 4096) -> None:
        super().__init__(CANConnection(), endpoint, max_pending)
        self.bitrate = bitrate
        self.malformed = 0
        """Received frames that are not classic CAN frames (CAN FD)."""
        self._bus = bus
        self._clock = WallClock()
        self._loop = asyncio.get_running_loop()
        self._turn = asyncio.Lock()
        self._sender = ThreadPoolExecutor(1, "can-send")
        self._stopping = threading.Event()
        self._reader = threading.Thread(target=self._read, name=f"reads {endpoint}", daemon=True)
        self._reader.start()

    @classmethod
    async def open(cls, endpoint: Endpoint, bitrate: int, *, max_pending: int = 4096) -> AdapterConnection:
        """Open the adapter at `bitrate` bit/s, or at ``?bitrate=`` of the endpoint.

        With ``?listen=1`` the adapter does not even acknowledge frames.

        Raises `UsageError` for an interface that python-can does not have, for a driver that is not installed, and if no bit rate
        is given to an adapter that needs one (a node with a wrong bit rate destroys the frames of all nodes). Raises
        `EndpointBusy` or `Unreachable` if the adapter is in use or missing.
        """
        rate = _bitrate(endpoint, bitrate)
        words = _words(endpoint, rate)
        opening = asyncio.get_running_loop().run_in_executor(None, _open, endpoint, words)
        try:
            bus = await asyncio.shield(opening)
        except asyncio.CancelledError:
            opening.add_done_callback(_shut_unwanted)
            raise
        return cls(endpoint, bus, rate, max_pending)

    async def send(self, frame: CanFrame) -> None:
        """Pass `frame` to the driver, waiting while its transmit queue is full.

        Raises `ConnectionLost` if the adapter is gone, `WireError` if its queue stays full for `SEND_TIMEOUT_S`.
        """
        message = message_of(frame, self.endpoint)
        async with self._turn:
            if self._lost is not None:
                raise self._loss()
            try:
                await self._loop.run_in_executor(self._sender, self._bus.send, message, SEND_TIMEOUT_S)
            except can.CanTimeoutError as e:
                raise WireError(
                    f"the adapter did not accept a frame for {SEND_TIMEOUT_S:g} s",
                    where=str(self.endpoint),
                    hint="check that another node acknowledges, the bit rate, and the cable",
                ) from e
            except (OSError, can.CanError, ValueError) as e:
                self.feed_lost(_gone(self.endpoint, e))
                raise self._loss() from e

    async def aclose(self) -> None:
        """Close the adapter. Closing twice does nothing."""
        self.feed_lost(closed_locally(self.endpoint))
        if not self._stopping.is_set():
            self._stopping.set()
            await self._loop.run_in_executor(None, self._shut)
        self.inbound.data_stream.clear()

    def _shut(self) -> None:
        self._reader.join()
        self._sender.shutdown()
        try:
            self._bus.shutdown()
        except (
            OSError,
            can.CanError,
        ):  # The adapter was unplugged: slcan writes to the missing port, fails, and leaves it open.
            port = getattr(self._bus, "serialPortOrig", None)
            if port is not None:
                port.close()

    # -- the reading thread ----------------------------------------------------------------------------------------

    def _read(self) -> None:
        while not self._stopping.is_set():
            try:
                message = self._bus.recv(POLL_S)
            except (OSError, can.CanError, ValueError) as e:
                self._tell(self.feed_lost, _gone(self.endpoint, e))
                return
            if message is not None:
                self._tell(self._take, message)

    def _tell(self, what: Any, item: Any) -> None:
        try:
            self._loop.call_soon_threadsafe(what, item)
        except RuntimeError:
            self._stopping.set()  # the loop is closed: stop reading

    def _take(self, message: can.Message) -> None:
        if self._lost is not None:
            return
        if message.is_fd:
            self.malformed += 1
            return
        try:
            frame = CanFrame(
                message.arbitration_id,
                b"" if message.is_remote_frame else bytes(message.data),
                extended=message.is_extended_id,
                remote=message.is_remote_frame,
                error=message.is_error_frame,
                dlc=min(message.dlc, 8),
                t_ns=self._clock.monotonic_ns(),  # the time stamps of the drivers begin at different times
            )
        except Desync:
            self.malformed += 1
            return
        self.feed(frame)


def _bitrate(endpoint: Endpoint, asked: int) -> int:
    text = endpoint.param("bitrate", "0")
    if not text.isascii() or not text.isdigit() or len(text) > 7:
        raise UsageError(f"{endpoint}: bitrate", expected="bit/s, such as 250000", got=repr(text))
    said = int(text)
    if said and asked and said != asked:
        raise UsageError(f"{endpoint}: two different bit rates", expected=f"{asked} bit/s", got=f"{said} bit/s")
    rate = said or asked
    if not rate and endpoint.interface not in RATELESS:
        raise UsageError(
            f"{endpoint}: an adapter needs the bit rate of its bus",
            expected="?bitrate=250000 after the channel",
            hint="an adapter with a wrong bit rate destroys the frames of all nodes",
        )
    return rate


def _words(endpoint: Endpoint, rate: int) -> dict[str, Any]:
    """Return the arguments for `can.Bus`. Raises `UsageError` for an unknown interface or an invalid parameter."""
    if endpoint.interface not in can.VALID_INTERFACES:
        known = sorted(set(can.VALID_INTERFACES) | {"socketcan", "fieldtwin"})
        raise UsageError(f"{endpoint}: unknown kind of CAN interface {endpoint.interface!r}", expected=", ".join(known))
    words: dict[str, Any] = {k: _typed(v) for k, v in endpoint.params if k not in _OWN}
    if rate and endpoint.interface not in RATELESS:
        words["bitrate"] = rate
    listen = endpoint.param("listen", "0")
    if listen not in ("0", "1"):
        raise UsageError(f"{endpoint}: listen", expected="0 or 1", got=repr(listen))
    if listen == "1":
        words |= _listen_only(endpoint)
    return words


def _typed(text: str) -> Any:
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return {"true": True, "false": False}.get(text.lower(), text)


def _listen_only(endpoint: Endpoint) -> dict[str, Any]:
    """Return the arguments that put this driver into listen-only mode. Raises `UsageError` if python-can has none for it."""
    match endpoint.interface:
        case "slcan":
            return {"listen_only": True}
        case "pcan" | "ixxat":
            return {"state": can.BusState.PASSIVE}
        case "kvaser":
            return {"driver_mode": False}  # DRIVER_MODE_SILENT
        case "virtual" | "udp_multicast":
            return {}  # this bus has no acknowledgements
        case interface:
            raise UsageError(f"{endpoint}: python-can has no listen-only mode for {interface}", got="listen=1")


def can_listen_only(endpoint: Endpoint) -> bool:
    """Return whether ``?listen=1`` is possible for this endpoint."""
    return endpoint.interface in ("slcan", "pcan", "ixxat", "kvaser", "virtual", "udp_multicast")


def _open(endpoint: Endpoint, words: dict[str, Any]) -> can.BusABC:
    channel: str | int = int(endpoint.path) if endpoint.path.isdigit() else endpoint.path
    try:
        return can.Bus(interface=endpoint.interface, channel=channel, ignore_config=True, **words)
    except (
        can.CanInterfaceNotImplementedError,
        ImportError,
        NameError,
        AttributeError,
    ) as e:  # the driver of Kvaser raises NameError
        raise _no_driver(endpoint, e) from e
    except (TypeError, ValueError) as e:
        raise UsageError(f"{endpoint}: the driver of {endpoint.interface} refuses these settings", got=str(e)) from e
    except (can.CanError, OSError) as e:
        if "library not found" in str(e):  # the message of the driver of PCAN
            raise _no_driver(endpoint, e) from e
        if "busy" in str(e).lower() or "in use" in str(e).lower():
            raise EndpointBusy("the adapter is held by another program", where=str(endpoint), hint=str(e)) from e
        raise Unreachable(
            f"cannot open the adapter: {e}", where=str(endpoint), hint="check that it is plugged in"
        ) from e


def _no_driver(endpoint: Endpoint, error: Exception) -> UsageError:
    return UsageError(
        f"{endpoint}: the driver of {endpoint.interface} is not installed",
        got=str(error),
        hint="install the maker's library, and python-can's extra for it: pip install 'python-can[...]'",
    )


def _shut_unwanted(opening: asyncio.Future[can.BusABC]) -> None:
    """Close the adapter that `opening` has opened although the caller was cancelled meanwhile."""
    if not opening.cancelled() and opening.exception() is None:
        opening.result().shutdown()


def _gone(endpoint: Endpoint, error: Exception) -> ConnectionLost:
    return ConnectionLost(f"the CAN adapter is gone: {error}", where=str(endpoint))
