"""Determine the profile's command for a Modbus request, from the registers that the request reads or writes.

The names are those of the command list (docs/explanation/paper.md, ruling 12). This module performs no I/O. Like all emulator
code, it has its own decoder, which shares nothing with the drivers.
"""

from __future__ import annotations

from fieldtwin.emulators.replay.requests import CellRequest, parse_request
from fieldtwin.gateway.core.files.profile import DeviceProfile, RegisterRange


class CommandNames:
    """The commands of one Modbus profile."""

    def __init__(self, profile: DeviceProfile) -> None:
        self._reads: list[tuple[RegisterRange, str]] = []
        self._writes: list[tuple[RegisterRange, str]] = []
        for tag in profile.tags.values():
            if tag.readable:
                self._reads.append((tag.registers, f"read_{tag.poll}"))
            if tag.writable:
                self._writes.append((tag.registers, profile.command_for(tag.name)))
        if profile.inbox is not None and profile.outbox is not None:
            self._reads += [(at, "receive") for at in (profile.inbox.at, profile.inbox.ack)]
            self._reads += [(at, "send") for at in (profile.outbox.at, profile.outbox.ack)]
            self._writes += [(profile.inbox.ack, "acknowledge"), (profile.outbox.at, "send")]

    def of(self, pdu: bytes) -> str:
        """Return the name of the command in a request PDU: of several, the one with the lowest address; "" if there is none."""
        request = parse_request(pdu)
        if request is None:
            return ""
        touched = [
            (at.address, name)
            for at, name in (self._reads if request.values is None else self._writes)
            if _overlap(request, at)
        ]
        return min(touched)[1] if touched else ""


def _overlap(request: CellRequest, at: RegisterRange) -> bool:
    return request.table == at.table and at.address < request.addresses.stop and request.address < at.end
