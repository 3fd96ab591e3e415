"""The reason codes for the bad quality of a tag."""

from __future__ import annotations

from fieldtwin.gateway.core.errors import DeviceRefused, FieldtwinError, ReplyTimeout, Unreachable, WrongDevice
from fieldtwin.gateway.core.values import Reason
from fieldtwin.gateway.protocols.modbus.requests.refusals import GatewayRefusal
from fieldtwin.gateway.protocols.modbus.server.analysis import NO_RESPONSE


def reason_of(error: FieldtwinError) -> Reason:
    """Return the reason code for the bad quality of a tag after `error`."""
    if isinstance(error, WrongDevice):
        return Reason.WRONG_DEVICE
    if isinstance(error, GatewayRefusal):
        return Reason.TIMEOUT if error.code == NO_RESPONSE else Reason.UNREACHABLE
    if isinstance(error, DeviceRefused):
        return Reason.REFUSED
    if isinstance(error, ReplyTimeout):
        return Reason.TIMEOUT
    return Reason.UNREACHABLE if isinstance(error, Unreachable) else Reason.WIRE_ERROR
