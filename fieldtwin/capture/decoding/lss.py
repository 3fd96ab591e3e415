"""Decode LSS as a passive listener (CiA 305): requests on 7E5h, replies on 7E4h. Does no I/O; stores one open request."""

from __future__ import annotations

from dataclasses import replace

from fieldtwin.capture.decoding.exchange import DecodedExchange
from fieldtwin.gateway.core.errors import FieldtwinError
from fieldtwin.gateway.protocols.canopen.lss import frames as lss

_STATES = {0: "waiting", 1: "configuration"}
_SERVICES = {
    lss.SWITCH_GLOBAL: "switch state global", lss.CONFIGURE_NODE_ID: "configure node id",
    lss.CONFIGURE_BIT_TIMING: "configure bit timing", lss.ACTIVATE_BIT_TIMING: "activate bit timing",
    lss.STORE: "store configuration", lss.SWITCHED: "switched", lss.SLAVE_FOUND: "slave found",
    lss.NON_CONFIGURED_FOUND: "non-configured slave", lss.FASTSCAN: "fastscan",
    lss.IDENTIFY_NON_CONFIGURED: "identify non-configured slaves", lss.INQUIRE_NODE_ID: "inquire node id",
}  # fmt: skip
_PARTS = ("vendor", "product", "revision", "serial")
_RESULT = (lss.CONFIGURE_NODE_ID, lss.CONFIGURE_BIT_TIMING, lss.STORE)
_ANSWERED = {
    **{c: c for c in (*_RESULT, lss.INQUIRE_NODE_ID, *lss.INQUIRE)},
    lss.SWITCH_SELECTIVE[3]: lss.SWITCHED,
    lss.FASTSCAN: lss.SLAVE_FOUND,
    lss.IDENTIFY_NON_CONFIGURED: lss.NON_CONFIGURED_FOUND,
}
"""The command of each request that is answered, and the command of its answer."""
_MAY_BE_SILENT = (lss.FASTSCAN, lss.IDENTIFY_NON_CONFIGURED, lss.SWITCH_SELECTIVE[3])
"""Services for which no reply is a valid result: no node matches."""


class LssWatch:
    """The decoder of the LSS traffic of one bus."""

    def __init__(self, bus: str) -> None:
        self.bus = bus
        self._open: DecodedExchange | None = None

    def feed(self, data: bytes, reply: bool, t_ns: int) -> tuple[str, list[DecodedExchange]]:
        """Decode a frame with an LSS identifier (`reply`: 7E4h); return its description and the exchanges that it completed."""
        if not data:
            return "LSS without data", []
        return self._reply(data, t_ns) if reply else self._request(data, t_ns)

    def pending(self) -> list[DecodedExchange]:
        """Return the request whose reply may still come. The call has no side effects."""
        return [] if self._open is None else [replace(self._open, problem="pending", reply_text="pending")]

    def finish(self) -> list[DecodedExchange]:
        """End the trace: return the request that is still open, as unanswered."""
        now, self._open = self._open, None
        if now is None:
            return []
        silent = now.request[0] in _MAY_BE_SILENT
        return [replace(now, problem="" if silent else "no reply", reply_text="no reply")]

    def _request(self, data: bytes, t_ns: int) -> tuple[str, list[DecodedExchange]]:
        done = self.finish()
        service, detail = _named(data)
        now = DecodedExchange(
            t_ns, t_ns, self.bus, "", 0, 0, f"LSS {service}", request=data, text=f"LSS {service}{detail}"
        )
        if data[0] in _ANSWERED:
            self._open = now
        else:
            done.append(now)
        return now.text, done

    def _reply(self, data: bytes, t_ns: int) -> tuple[str, list[DecodedExchange]]:
        now = self._open
        if now is None or _ANSWERED[now.request[0]] != data[0]:
            return f"LSS {_named(data)[0]}, without a request", []
        self._open = None
        text, problem = "yes", ""
        if data[0] in _RESULT:
            try:
                lss.check_result("", data.ljust(8, b"\0"))
                text = "done"
            except FieldtwinError as e:
                text, problem = e.message.removeprefix("LSS : "), "abort"
        elif data[0] in lss.INQUIRE:
            text = f"{int.from_bytes(data[1:5], 'little'):X}h"
        elif data[0] == lss.INQUIRE_NODE_ID:
            text = str(data[1]) if len(data) > 1 else "nothing"
        done = replace(now, end_ns=t_ns, latency_ns=t_ns - now.t_ns, reply=data, problem=problem, reply_text=text)
        return f"{now.service}: {text}", [done]


def _named(data: bytes) -> tuple[str, str]:
    """Return the service of a frame, and its parameters in words."""
    command, number = data[0], int.from_bytes(data[1:5], "little")
    if command in lss.SWITCH_SELECTIVE:
        return "switch state selective", f" {_PARTS[command - lss.SWITCH_SELECTIVE[0]]} {number:X}h"
    if command in lss.INQUIRE:
        return f"inquire {_PARTS[command - lss.INQUIRE[0]]}", ""
    service = _SERVICES.get(command, f"command {command:02X}h")
    if command == lss.SWITCH_GLOBAL and len(data) > 1:
        return service, f" to {_STATES.get(data[1], str(data[1]))}"
    if command == lss.CONFIGURE_NODE_ID and len(data) > 1:
        return service, f" {data[1]}"
    if command == lss.FASTSCAN and len(data) > 6:
        part = _PARTS[data[6]] if data[6] < 4 else "?"
        return service, " from the start" if data[5] == lss.ANY_SLAVE else f" {part} {number:X}h, bits from {data[5]}"
    return service, ""
