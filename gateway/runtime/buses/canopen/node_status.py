"""The CAN bus's record of one node, and the node's part of the gateway's status."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, field

from fieldtwin.gateway.core.clock import NS_PER_MS
from fieldtwin.gateway.devices.canopen_device import CanopenDriver
from fieldtwin.gateway.protocols.canopen.emcy_log import EmcyLog
from fieldtwin.gateway.runtime.buses.backoff import Backoff
from fieldtwin.gateway.runtime.buses.canopen.node_writes import NodeWrites
from fieldtwin.gateway.runtime.buses.poll_schedule import PollSchedule
from fieldtwin.gateway.runtime.gateway_status import DeviceStatus, EmcyStatus, TpdoStatus


@dataclass
class NodeStatus:
    """The bus's record of one node.

    `wanted` is set while the node has to be checked, configured and started (again), `up` while this is done and valid.
    """

    driver: CanopenDriver
    writes: NodeWrites
    schedule: PollSchedule
    online: bool = False
    error: str = "not asked yet"
    boots: int = 0
    conflicts: int = 0
    conflict: str = ""
    """The last sign of a second node with this node ID. It is kept, because nothing proves that the second node was removed."""
    emcy_log: EmcyLog = field(default_factory=EmcyLog)
    bring_ups: int = 0
    polls: int = 0
    poll_errors: int = 0
    reading: bool = False
    """Whether a poll group of the node is being read over SDO."""
    polling: asyncio.Task[None] | None = None
    start_again: asyncio.TimerHandle | None = None
    wanted: asyncio.Event = field(default_factory=asyncio.Event)
    up: asyncio.Event = field(default_factory=asyncio.Event)
    booted: asyncio.Event = field(default_factory=asyncio.Event)
    backoff: Backoff = field(init=False)

    def __post_init__(self) -> None:
        config = self.driver.config
        self.backoff = Backoff(config.backoff_first_s, config.backoff_limit_s)

    @property
    def emcys(self) -> int:
        return self.emcy_log.total


def device_status(node: NodeStatus, bus: str, unstarted: str, now_ns: int) -> DeviceStatus:
    """Return the status of `node` on `bus` at `now_ns`; `unstarted` names the tags without a value because it is not started."""
    return DeviceStatus(
        bus=bus,
        address=node.driver.node,
        online=node.online,
        error=node.error or node.conflict,
        conflicts=node.conflicts,
        conflict=node.conflict,
        unstarted=unstarted,
        identity_error=node.driver.identity_error,
        boots=node.boots,
        bring_ups=node.bring_ups,
        emcys=node.emcys,
        emcy=[f"{code:04X}h" for code in node.emcy_log.active],
        emcy_log=[
            EmcyStatus(
                age_ms=(now_ns - entry.t_ns) // NS_PER_MS,
                code=f"{entry.emcy.code:04X}h",
                meaning=entry.emcy.meaning,
                register=entry.emcy.register,
                vendor=entry.emcy.vendor.hex(),
            )
            for entry in node.emcy_log.entries
        ],
        errors=node.driver.malformed_pdos + node.poll_errors,
        polls=node.polls,
        tpdos={
            str(t.number): TpdoStatus(cob_id=f"{t.cob_id:03X}h", tags=list(t.tags), frames=t.frames)
            for t in node.driver.tpdos
        },
        rpdos={str(r.number): [tag for tag in r.tags if tag] for r in node.driver.rpdos},
        rpdos_sent=node.writes.frames,
    )
