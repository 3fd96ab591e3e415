"""What the gateway is told about CANopen besides addresses: what a bus's master produces, and how a node is booted."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

from fieldtwin.gateway.core.clock import NS_PER_MS
from fieldtwin.gateway.protocols.canopen.boot import Configuration, ExpectedIdentity
from fieldtwin.gateway.protocols.canopen.configure import PdoConfig
from fieldtwin.gateway.protocols.canopen.lss import LssAddress


@dataclass(frozen=True)
class CanopenBusConfig:
    """SYNC every `sync_ms` with a counter up to `sync_counter` (0: without), TIME every `time_ms`; 0: never.

    `short_sdo`: replies of fewer than 8 bytes are taken, as old controllers send them.
    """

    sync_ms: int = 0
    sync_counter: int = 0
    time_ms: int = 0
    short_sdo: bool = False


@dataclass(frozen=True)
class RpdoConfig:
    """The tags that RPDO1 of a node shall carry. `synchronous`: they count from the next SYNC on. `event_ms`: how often it
    is sent although nothing changed, 0 for never."""

    tags: tuple[str, ...]
    synchronous: bool = False
    event_ms: int = 0


@dataclass(frozen=True)
class CanopenNodeConfig:
    """`identity`: who has to answer. `configuration`: what it shall hold, from the DCF `dcf`.

    `lss`: the address under which it gets its node id where nobody has that. `tpdos`: the process data that it sends, as
    its DCF has them; None where `adopt_tpdos` says to read them from the node, or where nothing is said. `rpdos` and
    `adopt_rpdos`: the same of the process data that it takes; `rpdo1`: what its RPDO1 shall be.
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


def cycle_period_ns(bus: CanopenBusConfig, nodes: Iterable[CanopenNodeConfig]) -> int:
    """Return the communication cycle period of a bus in ns: how often its master produces SYNC, else the shortest period that a
    node's DCF sets (1006h); 0 where neither says it."""
    if bus.sync_ms:
        return bus.sync_ms * NS_PER_MS
    settings = (setting for node in nodes if node.configuration for setting in node.configuration.settings)
    periods = (int.from_bytes(s.data, "little") for s in settings if (s.index, s.subindex) == (0x1006, 0))
    return min((period_us * 1000 for period_us in periods if period_us), default=0)
