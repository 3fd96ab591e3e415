"""NMT commands and states, and the events that a master reports about its nodes (CiA 301, 7.2.8 and 7.3.2).

This module defines values and encodes frames; it does not send or receive them.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Literal

from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.protocols.canopen import cob_id


class NmtCommand(IntEnum):
    """Command specifiers of the NMT node control services (7.2.8.3.1)."""

    START = 0x01
    STOP = 0x02
    ENTER_PRE_OPERATIONAL = 0x80
    RESET_NODE = 0x81
    RESET_COMMUNICATION = 0x82

    @property
    def boots(self) -> bool:
        """Return whether the node boots after this command and sends a boot-up message."""
        return self in (NmtCommand.RESET_NODE, NmtCommand.RESET_COMMUNICATION)


class NmtState(IntEnum):
    """The state as a heartbeat carries it (7.2.8.3.2.2); INITIALISING is the boot-up message."""

    INITIALISING = 0x00
    STOPPED = 0x04
    OPERATIONAL = 0x05
    PRE_OPERATIONAL = 0x7F


NodeEventKind = Literal["boot-up", "heartbeat-lost", "heartbeat-back", "state", "emcy", "conflict"]


@dataclass(frozen=True, slots=True)
class NodeEvent:
    """An event concerning `node`.

    `state` is the node's state after the event (None: no state was ever received). `data` is the data of the frame that caused
    the event, if any. `t_ns` is monotonic. `unexpected` marks a boot-up that this master did not request, of a node that it had
    heard before: the node restarted and has lost its configuration (CO-035). A ``conflict`` means that two nodes seem to share
    this node ID (CO-042): `data` is the second reply to one request, or the second boot-up; `first` is the first reply, if known.
    """

    node: int
    kind: NodeEventKind
    state: NmtState | None
    data: bytes
    t_ns: int
    unexpected: bool = False
    first: bytes = b""


def conflict_text(event: NodeEvent) -> str:
    """Return a text about a conflict: which message was received twice, and what that means."""
    end = f"two nodes seem to have the id {event.node}"
    if len(event.data) != 8:
        return f"two boot-ups in a row: {end}"
    name = f"{int.from_bytes(event.data[1:3], 'little'):04X}h:{event.data[3]:02X}"
    if not event.first:
        return f"a second reply to one request for {name}: {end}"
    if event.first == event.data:
        return f"the same reply twice to one request for {name} ({event.data.hex(' ')}): {end}"
    return f"two replies to one request for {name}, {event.first.hex(' ')} and {event.data.hex(' ')}: {end}"


def command_frame(command: NmtCommand, node: int) -> CanFrame:
    """Return the NMT frame with `command` for `node` (0: all nodes)."""
    if node != cob_id.ALL_NODES:
        cob_id.check_node(node)
    return CanFrame(cob_id.NMT, bytes([command, node]))


def heartbeat_state(data: bytes) -> NmtState | None:
    """Return the state in a heartbeat or boot-up message, or None if it is neither (CO-039).

    A heartbeat has one byte. If bit 7 is set, the message is a node guarding reply or unknown.
    """
    return _STATES.get(data[0]) if len(data) == 1 else None


_STATES = {int(state): state for state in NmtState}
