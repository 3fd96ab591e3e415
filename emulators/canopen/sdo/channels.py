"""The SDO servers of a node: the default server and those of 1201h to 127Fh (CiA 301 v4.2, 7.5.2.33).

This module assigns identifiers to servers and counts frames. The module `server` handles the transfers.
"""

from __future__ import annotations

from fieldtwin.emulators.canopen.aborts import Abort, abort
from fieldtwin.emulators.canopen.sdo.server import ObjectAccess, SdoServer
from fieldtwin.emulators.canopen.service import NEVER, Core, NodeService

REQUEST, RESPONSE = 0x600, 0x580
DEFAULT = 0x1200
_ADDITIONAL = range(0x1201, 0x1280)
_TO_SERVER, _TO_CLIENT = 1, 2
_INVALID = 1 << 31
_RESERVED = 0x3FFFF800
"""The bits of an identifier entry that must be 0. They include the frame bit, because 29-bit identifiers are not supported."""


class SdoChannels(NodeService):
    """All SDO servers of a node, each with its own transfer. `tolerate_short` accepts requests of fewer than 8 bytes."""

    due_ns: int = NEVER
    """The time at which the first of the transfers needs a call."""

    def __init__(self, core: Core, access: ObjectAccess, timeout_ns: int, block: int, *, tolerate_short: bool) -> None:
        self._core = core
        self._tolerate_short = tolerate_short
        additional = [index for index in sorted(core.data.dictionary.objects) if index in _ADDITIONAL]
        self._servers = {index: SdoServer(access, timeout_ns, block) for index in (DEFAULT, *additional)}

    def owns(self, index: int) -> bool:
        return index == DEFAULT or index in self._servers

    def check_write(self, index: int, subindex: int, raw: bytes) -> None:
        """Check a write to a server's identifiers: only those of an additional server that is marked invalid may change."""
        if subindex not in (_TO_SERVER, _TO_CLIENT):
            return
        if index == DEFAULT:
            raise abort(index, subindex, Abort.READ_ONLY)
        new, old = int.from_bytes(raw, "little"), self._core.data.number(index, subindex, _INVALID)
        valid = self._ids(index) is not None
        if new & _RESERVED or (valid and not new & _INVALID and new != old):
            raise abort(index, subindex, Abort.VALUE)

    def wrote(self, index: int, subindex: int, now_ns: int) -> None:
        if subindex in (_TO_SERVER, _TO_CLIENT):
            self._servers[index].reset()
            self._find_due()

    def reset(self, now_ns: int) -> None:
        for server in self._servers.values():
            server.reset()
        self.due_ns = NEVER

    def state_changed(self, now_ns: int) -> None:
        if not self._core.communicating:
            self.reset(now_ns)

    def receive(self, can_id: int, data: bytes, now_ns: int) -> bool:
        """Process a data frame. Return whether it is a request to one of the servers, whether answered or not."""
        for index, server in self._servers.items():
            ids = self._ids(index)
            if ids is not None and ids[0] == can_id:
                self._request(server, ids[1], data, now_ns)
                self._find_due()
                return True
        return False

    def tick(self, now_ns: int) -> None:
        for index, server in self._servers.items():
            if server.deadline_ns is not None and now_ns >= server.deadline_ns:
                ids = self._ids(index)
                for reply in server.tick(now_ns) if ids else ():
                    self._send(ids[1] if ids else 0, reply, now_ns)
        self._find_due()

    def _find_due(self) -> None:
        due_ns = NEVER
        for server in self._servers.values():
            if server.deadline_ns is not None and server.deadline_ns < due_ns:
                due_ns = server.deadline_ns
        self.due_ns = due_ns

    def _ids(self, index: int) -> tuple[int, int] | None:
        """Return the identifiers of requests and responses; None if the server is not valid."""
        if index == DEFAULT:
            return REQUEST + self._core.node_id, RESPONSE + self._core.node_id
        data = self._core.data
        request, response = (data.number(index, sub, _INVALID) for sub in (_TO_SERVER, _TO_CLIENT))
        return None if (request | response) & _INVALID else (request & 0x7FF, response & 0x7FF)

    def _request(self, server: SdoServer, response_id: int, data: bytes, now_ns: int) -> None:
        short = len(data) < 8
        if not self._core.communicating or (short and not (data and self._tolerate_short)):
            self._core.counters.ignored += 1
            return
        self._core.counters.sdo_requests += data[0] >> 5 != 4 or (server.in_sub_block and data[0] != 0x80)
        for reply in server.request(data.ljust(8, b"\0"), now_ns):
            self._core.counters.sdo_replies += 1
            self._send(response_id, reply, now_ns)

    def _send(self, response_id: int, reply: bytes, now_ns: int) -> None:
        self._core.counters.sdo_aborts += reply[0] == 0x80
        self._core.send(response_id, reply, now_ns)
