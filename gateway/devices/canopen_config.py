"""What the gateway is told about CANopen besides addresses: what a bus's master produces, and how a node is booted."""

from __future__ import annotations

from dataclasses import dataclass, field

from gateway.protocols.canopen.boot import Configuration, ExpectedIdentity
from gateway.protocols.canopen.configure import PdoConfig
from gateway.protocols.canopen.lss import LssAddress


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
