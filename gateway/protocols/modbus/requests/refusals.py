"""Exception replies that are not a simple refusal: one type for each code that a caller handles differently.

The types state only what the code means (TG 4.4.2.5, AP 7); the caller decides what to do. Every other code, vendor
codes included, is a plain `ModbusExceptionReply`.
"""

from __future__ import annotations

from fieldtwin.gateway.core.errors import ModbusExceptionReply


class Acknowledged(ModbusExceptionReply):
    """Code 05: the request was accepted and takes long. This is not a failure: continue polling, and do not repeat a write."""


class ServerBusy(ModbusExceptionReply):
    """Code 06: the request was not accepted because the server is busy. Repeat it after a pause."""


class IllegalAddress(ModbusExceptionReply):
    """Code 02: at least one of the addresses does not exist. A read that covers several values may then be split."""


class GatewayRefusal(ModbusExceptionReply):
    """Codes 0A and 0B, which a gateway between client and unit sends.

    0A: the gateway has no path to the unit, which never received the request. 0B: the unit did not answer, but may have executed
    the request.
    """


_TYPES: dict[int, type[ModbusExceptionReply]] = {
    0x02: IllegalAddress,
    0x05: Acknowledged,
    0x06: ServerBusy,
    0x0A: GatewayRefusal,
    0x0B: GatewayRefusal,
}


def refusal(function: int, code: int, hint: str = "") -> ModbusExceptionReply:
    """Return the error for exception `code` to a request of `function`. `hint` gives the reason, which the reply does not
    contain.
    """
    error = _TYPES.get(code, ModbusExceptionReply)(function, code)
    error.hint = hint
    return error
