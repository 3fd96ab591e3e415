"""Writes of OPC UA clients: the checks of the request, the gateway's answer, and the status code of each.

The gateway carries out each write under its own rules (permission of the plant, `writable` tags, limits) and records it in the
audit log, as it does for Studio. A request that is refused here is recorded there, too. No value of a variable changes because
of a write: clients see a written value when the gateway has read it from the device.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Awaitable, Callable, Collection
from dataclasses import dataclass
from math import isfinite
from typing import Any

from asyncua import ua

from fieldtwin.gateway.core.control import RemoteError
from fieldtwin.gateway.core.errors import ConnectionLost, FieldtwinError, ReplyTimeout, Unreachable
from fieldtwin.northbound.opcua.access.users import Account

Call = Callable[..., Awaitable[Any]]
"""Calls a command of the gateway's control channel, with its arguments."""
NUMBERS = ("SByte", "Byte", "Int16", "UInt16", "Int32", "UInt32", "Int64", "UInt64", "Float", "Double", "Boolean")
"""The data types that can be written. Texts cannot."""
MOST_SHOWN = 80
"""The largest number of characters of a refused value in the audit log."""
CODES: dict[str, str] = {
    "OutOfLimits": "BadOutOfRange",
    "NotAllowed": "BadNotWritable",
    "EndpointBusy": "BadInvalidState",
    "Unreachable": "BadNoCommunication",
    "ConnectionLost": "BadNoCommunication",
    "ReplyTimeout": "BadTimeout",
    "CrcError": "BadCommunicationError",
    "Desync": "BadCommunicationError",
    "WrongSize": "BadCommunicationError",
    "WireError": "BadCommunicationError",
    "DeviceRefused": "BadDeviceFailure",
    "ModbusExceptionReply": "BadDeviceFailure",
    "SdoAborted": "BadDeviceFailure",
    "UnknownCommand": "BadDeviceFailure",
    "VerifyFailed": "BadDeviceFailure",
    "WrongDevice": "BadConfigurationError",
}
"""The status code for each kind of error of the gateway. Any other kind is `BadUnexpectedError`."""
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Refusal:
    """A write that is not passed to the gateway: its status code, the reason, and its cause in the journal of refusals."""

    code: str
    reason: str
    cause: str = "not writable"


class TagWrites:
    """The writes of one server. `data_types` gives the data type of each variable, `tags` are the variables of tags."""

    def __init__(self, server: str, call: Call, data_types: dict[str, str], tags: Collection[str]) -> None:
        self.counters: Counter[str] = Counter(writes=0, refused=0)
        self._server = server
        self._call = call
        self._data_types = data_types
        self._tags = frozenset(tags)

    async def write(self, item: Any, name: str, account: Account | None, address: str) -> str:
        """Carry out a write of the variable `name` for a user at `address`. Return the name of the status code."""
        by = f"opcua {self._server} {account.name if account is not None else 'anonymous'} {address}"
        refusal = self._refusal(item, name, account)
        try:
            if refusal is None:
                await self._call("write", tag=name, value=_number(item.Value.Value.Value), by=by)
                self.counters["writes"] += 1
                return "Good"
            shown = repr(item.Value.Value.Value if item.Value.Value is not None else None)[:MOST_SHOWN]
            await self._call("refuse", tag=name, value=shown, reason=refusal.reason, cause=refusal.cause, by=by)
        except RemoteError as e:
            return self._refused(CODES.get(e.kind, "BadUnexpectedError"), name, by, str(e))
        except (Unreachable, ConnectionLost, ReplyTimeout) as e:
            return self._refused(CODES[type(e).__name__], name, by, str(e))
        except FieldtwinError as e:
            return self._refused("BadUnexpectedError", name, by, str(e))
        assert refusal is not None
        return self._refused(refusal.code, name, by, refusal.reason)

    def _refused(self, code: str, name: str, by: str, reason: str) -> str:
        self.counters["refused"] += 1
        _log.warning("write of %s by %s: %s: %s", name, by, code, reason)
        return code

    def _refusal(self, item: Any, name: str, account: Account | None) -> Refusal | None:
        """Return why a write is refused by the rules of OPC 10000-4, 5.11.4; None if the gateway has to decide."""
        if name not in self._tags or item.AttributeId != ua.AttributeIds.Value:
            return Refusal("BadNotWritable", "only values of tags can be written")
        if account is None:
            return Refusal("BadNotWritable", "writes need a server with `security` and users")
        if not account.may_write:
            return Refusal("BadUserAccessDenied", f"the role {account.role} may not write")
        data = item.Value
        if item.IndexRange or (data.StatusCode is not None and not data.StatusCode.is_good()):
            return Refusal("BadWriteNotSupported", "only whole values with the status Good can be written")
        kind, variant = self._data_types[name], data.Value
        if variant is None or variant.is_array or variant.Value is None or variant.VariantType.name != kind:
            got = "no value" if variant is None else f"{variant.VariantType.name}{'[]' if variant.is_array else ''}"
            return Refusal("BadTypeMismatch", f"the type is {got}, not {kind}", "limit")
        if kind not in NUMBERS:
            return Refusal("BadNotWritable", "texts cannot be written")
        if not isfinite(variant.Value) or float(variant.Value) != variant.Value:
            return Refusal("BadOutOfRange", "the value is not finite, or has more than 53 significant bits", "limit")
        return None


def _number(value: Any) -> int | float:
    return int(value) if isinstance(value, bool | int) else float(value)
