"""CANopen settings of buses and nodes: the SYNC and TIME that the master produces, and how a node is booted."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

from fieldtwin.gateway.core.clock import NS_PER_MS
from fieldtwin.gateway.protocols.canopen.boot import Configuration, ExpectedIdentity
from fieldtwin.gateway.protocols.canopen.configure import PdoConfig
from fieldtwin.gateway.protocols.canopen.lss.frames import LssAddress
from fieldtwin.gateway.protocols.canopen.sdo.transfers import WHOLE_S


@dataclass(frozen=True)
class CanopenBusConfig:
    """The settings of a bus's CANopen master.

    It sends SYNC every `sync_ms`, with a counter up to `sync_counter` (0: no counter), and TIME every `time_ms` (0: never). With
    `short_sdo` it accepts replies of fewer than 8 bytes, as old controllers send them. `sdo_transfer_s` is the longest time for a
    whole SDO transfer, in seconds.
    """

    sync_ms: int = 0
    sync_counter: int = 0
    time_ms: int = 0
    short_sdo: bool = False
    sdo_transfer_s: float = WHOLE_S


@dataclass(frozen=True)
class RpdoConfig:
    """The tags that RPDO1 of a node has to carry.

    With `synchronous` the values take effect at the next SYNC. `event_ms` is the period in which the RPDO is sent without a
    change; 0: never.
    """

    tags: tuple[str, ...]
    synchronous: bool = False
    event_ms: int = 0


@dataclass(frozen=True)
class CanopenNodeConfig:
    """The settings with which a node is booted.

    `identity` is the expected identity, and `configuration` the configuration that the node has to hold, from the DCF `dcf`.
    `lss` is the LSS address by which the node gets its node ID if no node on the bus has that ID. `tpdos` are the TPDOs of the
    DCF; None if they are read from the node (`adopt_tpdos`), or if nothing is configured. `rpdos` and `adopt_rpdos` are the
    same for RPDOs, and `rpdo1` is the configuration for RPDO1. `sdo_transfer_s` replaces the limit of the bus for this node
    unless it is None.
    """

    identity: ExpectedIdentity = field(default_factory=ExpectedIdentity)
    dcf: str = ""
    configuration: Configuration | None = None
    lss: LssAddress | None = None
    tpdos: tuple[PdoConfig, ...] | None = None
    adopt_tpdos: bool = False
    rpdo1: RpdoConfig | None = None
    rpdos: tuple[PdoConfig, ...] | None = None
    adopt_rpdos: bool = False
    sdo_transfer_s: float | None = None


def cycle_period_ns(bus: CanopenBusConfig, nodes: Iterable[CanopenNodeConfig]) -> int:
    """Return the communication cycle period of a bus in ns: the SYNC period of its master, else the shortest period
    that a node's DCF sets (1006h), else 0."""
    if bus.sync_ms:
        return bus.sync_ms * NS_PER_MS
    settings = (setting for node in nodes if node.configuration for setting in node.configuration.settings)
    periods = (int.from_bytes(s.data, "little") for s in settings if (s.index, s.subindex) == (0x1006, 0))
    return min((period_us * 1000 for period_us in periods if period_us), default=0)
