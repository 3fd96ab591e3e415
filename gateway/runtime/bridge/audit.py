"""Audit records of bridged writes and refusals: client, target, request and result.

A write is recorded before it is sent, and is not carried out if it cannot be recorded. Refusals of each client are recorded at
most once per second, with the number of refusals since the last record, so that a client cannot fill the disk.
"""

from __future__ import annotations

from fieldtwin.gateway.core.clock import NS_PER_S, Clock
from fieldtwin.gateway.core.errors import FieldtwinError, ModbusExceptionReply, Unreachable
from fieldtwin.gateway.protocols.modbus.requests.refusals import refusal
from fieldtwin.gateway.protocols.modbus.server.analysis import SERVER_FAILURE
from fieldtwin.gateway.protocols.modbus.server.forward import ForwardedReply
from fieldtwin.gateway.runtime.audit_log import AuditLog

MOST_CLIENTS = 256
"""The number of clients for which the last refusal is remembered."""


class WriteRecord:
    """Writes the audit entries of one bridge. `lost` counts entries that could not be written."""

    def __init__(self, audit: AuditLog, clock: Clock) -> None:
        self.lost = 0
        self._audit = audit
        self._clock = clock
        self._refusals: dict[str, tuple[int, int]] = {}

    def asked(self, by: str, device: str, unit: int, pdu: bytes) -> None:
        """Record a write that is about to be sent. Raises exception 04 for the client if it cannot be recorded."""
        try:
            self._audit.note("write", device, by=by, result="asked", unit=unit, pdu=pdu.hex())
        except Unreachable as e:
            self.lost += 1
            raise refusal(pdu[0], SERVER_FAILURE) from e

    def ended(self, by: str, device: str, unit: int, pdu: bytes, result: ForwardedReply | FieldtwinError) -> None:
        """Record the result of a write."""
        text = "done" if isinstance(result, ForwardedReply) else f"failed: {result}"
        if isinstance(result, ModbusExceptionReply):
            text = f"refused: exception {result.code:02X}h"
        self._note("write", device, by=by, result=text, unit=unit, pdu=pdu.hex())

    def refused(self, by: str, device: str, unit: int, pdu: bytes, code: int, why: str = "") -> None:
        """Record a write that was not forwarded."""
        client = by.partition(" (")[0].rpartition(":")[0] or by  # without the port and the role
        now_ns = self._clock.monotonic_ns()
        last_ns, held_back = self._refusals.pop(client, (0, 0))
        if last_ns and now_ns - last_ns < NS_PER_S:
            self._refusals[client] = (last_ns, held_back + 1)
            return
        self._refusals[client] = (now_ns, 0)
        if len(self._refusals) > MOST_CLIENTS:
            del self._refusals[next(iter(self._refusals))]
        text = why or f"exception {code:02X}h"
        self._note("refuse", device, by=by, result=text, unit=unit, pdu=pdu.hex(), more=held_back)

    def _note(self, action: str, device: str, *, by: str, result: str, unit: int, pdu: str, more: int = 0) -> None:
        details = {"more_refused_since": more} if more else {}
        try:
            self._audit.note(action, device, by=by, result=result, unit=unit, pdu=pdu, **details)
        except Unreachable:
            self.lost += 1  # the missing record is counted; the next write does not start without a record
