"""Select the framing of an endpoint, and create its framer. This module opens no connection."""

from __future__ import annotations

from typing import Literal

from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.protocols.modbus.frames.ascii import AsciiFramer
from fieldtwin.gateway.protocols.modbus.frames.framing import Framer
from fieldtwin.gateway.protocols.modbus.frames.mbap import MbapFramer, UdpFramer
from fieldtwin.gateway.protocols.modbus.frames.rtu import RtuFramer

Framing = Literal["rtu", "ascii", "mbap", "udp"]

_OF_SCHEME: dict[str, Framing] = {
    "rtu": "rtu",
    "ascii": "ascii",
    "rtu+tcp": "rtu",
    "tcp": "mbap",
    "tls": "mbap",
    "udp": "udp",
}


def framing_of(endpoint: Endpoint) -> Framing:
    """Return the framing for the scheme of `endpoint`. Raises `UsageError` if the scheme is not one of Modbus."""
    if endpoint.scheme not in _OF_SCHEME:
        raise UsageError(
            "this kind of endpoint does not carry Modbus", expected=", ".join(_OF_SCHEME), got=str(endpoint)
        )
    return _OF_SCHEME[endpoint.scheme]


def make_framer(framing: str, *, char_time_ns: int, echo: bool, strict: bool, accepts_zero_id: bool) -> Framer:
    """Return a framer for one connection. Raises `UsageError` for a setting that the framing does not have."""
    serial = framing in ("rtu", "ascii")
    if framing not in _OF_SCHEME.values():
        raise UsageError(f"unknown Modbus framing {framing!r}", expected="rtu, ascii, mbap or udp")
    if echo and not serial:
        raise UsageError("only a serial line echoes", got=f"echo with framing {framing}")
    if strict and framing != "rtu":
        raise UsageError("only RTU frames are separated by silences", got=f"strict with framing {framing}")
    if strict and not char_time_ns:
        raise UsageError("strict RTU timing needs the baud rate and frame of the line")
    if accepts_zero_id and serial:
        raise UsageError("a serial line has no transaction ids", got=f"framing {framing}")
    match framing:
        case "rtu":
            return RtuFramer(echo=echo, strict=strict, char_time_ns=char_time_ns)
        case "ascii":
            return AsciiFramer(echo=echo)
        case "mbap":
            return MbapFramer(accepts_zero_id=accepts_zero_id)
        case _:
            return UdpFramer(accepts_zero_id=accepts_zero_id)
