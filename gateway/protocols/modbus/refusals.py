"""Exception replies that are not a simple refusal: one type for each that a caller handles differently.

The types state only what the code means (TG 4.4.2.5, AP 7); the caller decides what to do. Every other code, vendor
codes included, is a plain `ModbusExceptionReply`.
"""

from __future__ import annotations

from fieldtwin.gateway.core.errors import ModbusExceptionReply


class Acknowledged(ModbusExceptionReply):
    """Code 05: the request was accepted and takes long. This is not a failure: keep polling, and do not send a write again."""


class ServerBusy(ModbusExceptionReply):
    """Code 06: the request was not accepted because the server is busy. Back off, then repeat it; there is no value."""


class IllegalAddress(ModbusExceptionReply):
    """Code 02: at least one of the addresses does not exist. A merged read that gets it may be split."""


class GatewayRefusal(ModbusExceptionReply):
    """Codes 0A and 0B: a gateway on the way has no path to the unit (0A), or got no answer from it (0B).

    The unit itself never saw the request (0A), or may have executed it (0B).
    """


_TYPES: dict[int, type[ModbusExceptionReply]] = {
    0x02: IllegalAddress,
    0x05: Acknowledged,
    0x06: ServerBusy,
    0x0A: GatewayRefusal,
    0x0B: GatewayRefusal,
}


def refusal(function: int, code: int) -> ModbusExceptionReply:
    """Return the error for exception `code` to a request of `function`."""
    return _TYPES.get(code, ModbusExceptionReply)(function, code)
