"""Observe a CAN bus passively: the nodes with heartbeats, the SDO traffic, and all other frames. The module does no I/O.

Identifiers are interpreted by the predefined connection set of CiA 301, 7.3.3. The caller must not feed frames that it sent.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.protocols.canopen.nmt.states import NmtState
from fieldtwin.gateway.protocols.canopen.pdo.sync_watch import SyncWatch

_STUFF = 1.1
"""Estimated number of transmitted bits for each data bit of a frame, including stuff bits."""


@dataclass(slots=True)
class ObservedNode:
    """The messages of one node ID in the observed traffic.

    `state` is from its heartbeat; `period_s` is the time in seconds between two heartbeats; `pdos` counts frames with the
    predefined PDO identifiers of this node, which may belong to a different node if the identifiers were configured.
    """

    state: NmtState | None = None
    heartbeats: int = 0
    boot_ups: int = 0
    period_s: float = 0.0
    emergencies: int = 0
    sdo_replies: int = 0
    pdos: int = 0
    last_ns: int = 0

    @property
    def certain(self) -> bool:
        """Return whether the node certainly exists: messages were seen that only this node can send, and not only PDOs."""
        return bool(self.heartbeats or self.boot_ups or self.sdo_replies or self.emergencies)


@dataclass(slots=True)
class ObservedBus:
    """The traffic that was observed on a bus: its nodes, and the totals of its frames."""

    frames: int = 0
    errors: int = 0
    extended: int = 0
    bits: float = 0.0
    nodes: dict[int, ObservedNode] = field(default_factory=dict)
    sdo_masters: dict[int, int] = field(default_factory=dict)
    """The time (ns) of the last SDO request that another master sent to each node."""
    nmt_commands: int = 0
    commands: int = 0
    """Number of frames with a predefined RPDO identifier."""
    syncs: int = 0
    sync_producers: str = ""
    """The reason to assume more than one SYNC producer; empty without evidence."""
    times: int = 0
    lss_requests: int = 0
    others: int = 0
    """Number of frames that are not CANopen."""

    @property
    def has_master(self) -> bool:
        """Return whether a master sends commands on this bus."""
        return bool(self.sdo_masters or self.nmt_commands or self.lss_requests or self.commands)

    def load(self, seconds: float, bitrate: int) -> float:
        """Return the share of the bus capacity (0 to 1) that the frames took in `seconds`; 0 if `bitrate` (bit/s) is 0, not
        known.
        """
        return self.bits / (seconds * bitrate) if seconds > 0 and bitrate else 0.0


class BusListener:
    """A listener that is fed every received frame and counts the observed messages in `heard`."""

    def __init__(self) -> None:
        self.heard = ObservedBus()
        self._sync = SyncWatch()

    def feed(self, frame: CanFrame, t_ns: int) -> None:
        """Add a frame received at `t_ns`."""
        heard = self.heard
        if frame.error:
            heard.errors += 1
            return
        heard.frames += 1
        heard.bits += (67 if frame.extended else 47) + 8 * len(frame.data) * _STUFF
        if frame.extended:
            heard.extended += 1
            return
        function, node = frame.can_id & 0x780, frame.can_id & 0x7F
        if frame.can_id == 0:
            heard.nmt_commands += 1
        elif frame.can_id == 0x80:
            heard.syncs += 1
            self._sync.feed(frame.data, t_ns)
            heard.sync_producers = self._sync.verdict
        elif frame.can_id == 0x100:
            heard.times += 1
        elif frame.can_id == 0x7E5:
            heard.lss_requests += 1
        elif frame.can_id == 0x7E4:
            pass
        elif node == 0:
            heard.others += 1
        elif function == 0x600:
            heard.sdo_masters[node] = t_ns
        elif function in (0x200, 0x300, 0x400, 0x500):
            heard.commands += 1
        elif function in (0x080, 0x580, 0x700) or 0x180 <= function <= 0x500:
            self._of_node(function, node, frame, t_ns)
        else:
            heard.others += 1

    def _of_node(self, function: int, number: int, frame: CanFrame, t_ns: int) -> None:
        if function == 0x700 and (frame.remote or len(frame.data) != 1):
            return
        node = self.heard.nodes.setdefault(number, ObservedNode())
        match function:
            case 0x700 if frame.data[0] == 0:
                node.boot_ups += 1
                node.state = NmtState.INITIALISING
            case 0x700:
                state = frame.data[0] & 0x7F
                if node.heartbeats and node.last_ns:
                    node.period_s = (t_ns - node.last_ns) / NS_PER_S
                node.heartbeats += 1
                node.last_ns = t_ns
                node.state = NmtState(state) if state in [s.value for s in NmtState] else node.state
            case 0x080:
                node.emergencies += 1
            case 0x580:
                node.sdo_replies += 1
            case _:
                node.pdos += 1
