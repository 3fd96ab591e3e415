"""The inputs and results of a reply function: the request, correct and false answers to it, and the steps of the device."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

from fieldtwin.conformance.clients.modbus.device import ModbusWire
from fieldtwin.conformance.core.case import TRAIL_S, Basis, ClientCase, Elsewhere


@dataclass(frozen=True, slots=True)
class SendBytes:
    """A step of a hostile server: send `data`, `after_s` seconds after the request."""

    data: bytes
    after_s: float = 0.0
    good: bool = False


@dataclass(frozen=True, slots=True)
class HangUp:
    """A step of a hostile server: close the connection, by a reset if the transport has one."""

    after_s: float = 0.0
    reset: bool = False


@dataclass(frozen=True, slots=True)
class GoSilent:
    """A step of a hostile server: leave the connection open, and send nothing more on it."""

    after_s: float = 0.0


@dataclass(frozen=True, slots=True)
class Unplug:
    """A step of a hostile server: remove the port for `out_s` seconds and restore it under its name; then a different process
    holds it for `held_s` seconds.
    """

    out_s: float
    held_s: float = 0.0
    after_s: float = 0.0


ServerStep = SendBytes | HangUp | GoSilent | Unplug


@dataclass(frozen=True, slots=True)
class RequestContext:
    """One request that gets a wrong reply.

    `request` is unit ID and PDU, `tag` its transaction ID. `true` is the correct response PDU, `false` a response of the same
    form with the poison word. `nth` counts the requests of the case from 0. `timeout_s` is the client's response timeout, or
    the best guess. `first` is the context of the case's first request, None for that request itself.
    """

    wire: ModbusWire
    request: bytes
    tag: int
    true: bytes
    false: bytes
    nth: int = 0
    timeout_s: float = 1.0
    first: RequestContext | None = None

    @property
    def unit(self) -> int:
        return self.request[0]

    @property
    def function(self) -> int:
        return self.request[1]

    def good(self, after_s: float = 0.0) -> SendBytes:
        """Return the correct answer in a plain frame."""
        return SendBytes(self.frame(self.true), after_s, good=True)

    def frame(self, pdu: bytes) -> bytes:
        """Return a plain frame around any PDU."""
        return self.wire.frame(self.request, self.tag, pdu)

    def from_unit(self, unit: int, pdu: bytes) -> bytes:
        """Return a frame that another unit sent."""
        return self.wire.frame(bytes((unit,)), self.tag, pdu)

    @property
    def neighbour(self) -> int:
        """Return the ID of another unit."""
        return self.unit % 247 + 1

    def refuse(self, code: int, function: int | None = None) -> bytes:
        """Return an exception response in a plain frame."""
        return self.frame(bytes(((function or self.function) | 0x80, code)))


ReplyFunction = Callable[[RequestContext], list[ServerStep]]
Wants = Literal["register read", "read", "write", "read of several", "request to unit 0", "nothing"]


@dataclass(frozen=True, slots=True)
class ModbusCase:
    """A case with its reply function.

    `strikes` requests receive a wrong reply; `holds_good`: the faulty frames hold the correct word, and continue until the
    client has published it. `framings` lists the endpoints on which the case is possible (``rtu``, ``ascii``, ``tcp``;
    ``stream`` for those that can be closed, ``port`` for those that can be unplugged, ``lock`` for those that can be held).
    `needs` names an option without which the case makes no sense; `trail_s` is the time in seconds that the case continues
    after the recovery.
    """

    about: ClientCase
    play: ReplyFunction
    wants: Wants = "register read"
    strikes: int = 2
    holds_good: bool = False
    framings: tuple[str, ...] = ("rtu", "ascii", "tcp")
    needs: str = ""
    trail_s: float = TRAIL_S
    least: int = 1
    """Minimum number of requests that receive a wrong reply, even if the client has published the correct word before."""

    def on(self, **changes: object) -> ModbusCase:
        return replace(self, **changes)  # type: ignore[arg-type]

    def on_tcp(self, basis: Basis, clause: str) -> ModbusCase:
        """Return the case with a different basis and source on Modbus TCP."""
        there = Elsewhere("tcp", "TCP", basis, clause)
        return replace(self, about=replace(self.about, elsewhere=(there,)))
