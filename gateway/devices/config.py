"""What the gateway is told about its buses and devices: frozen, resolved, without a word on what is emulated."""

from __future__ import annotations

from dataclasses import dataclass, field

from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.profile import DeviceProfile
from fieldtwin.gateway.devices.canopen_config import CanopenBusConfig, CanopenNodeConfig


@dataclass(frozen=True)
class BusConfig:
    """A bus and the plant's endpoint of it. `bitrate` (bit/s) is for CAN only; what follows it is for Modbus.

    `spacing_s` is a pause behind every exchange, `turnaround_s` that behind a broadcast, `connect_pause_s` the one after
    the connection was opened. `echo`: what is sent comes back first. `strict`: RTU silences as SL 2.5.1.1 has them.
    `probe_share` of the bus's time, at most, goes to devices that do not answer while others do.
    """

    name: str
    endpoint: Endpoint
    timeout_s: float = 1.0
    retries: int = 1
    bitrate: int = 125_000
    canopen: CanopenBusConfig = field(default_factory=CanopenBusConfig)
    spacing_s: float = 0.0
    turnaround_s: float = 0.1
    connect_pause_s: float = 0.0
    echo: bool = False
    strict: bool = False
    probe_share: float = 0.1


@dataclass(frozen=True)
class Heartbeat:
    """CANopen heartbeat times in milliseconds: the node's producer time and our consumer time.

    `producer_ms` None: the node's producer time (1017h) is left as it is, and the gateway only listens.
    """

    producer_ms: int | None
    consumer_ms: int


@dataclass(frozen=True)
class Tpdo:
    """The tags that TPDO1 of a node shall carry, and its event timer in milliseconds."""

    tags: tuple[str, ...]
    event_ms: int


@dataclass(frozen=True)
class DeviceConfig:
    """A device of the system. `address` is the Modbus unit id (1 to 255) or the CANopen node id (1 to 127).

    `poll` gives each group's period in milliseconds; a group without one is read once after connecting. `phase` is where
    in its period a group is read, in milliseconds; the others are spread. `timeout_s` and `retries` None: as the bus.
    `spacing_s` is the device's pause behind each exchange with it. While it does not answer it is left alone for
    `backoff_first_s`, then twice as long, up to `backoff_limit_s`.
    `writable` and `safe` are what the system file allows to be written, and what is written when the controller is lost.
    """

    name: str
    profile: DeviceProfile
    bus: str
    address: int
    poll: dict[str, int] = field(default_factory=dict)
    expect: dict[str, str] = field(default_factory=dict)
    stale_after_ms: int = 5000
    writable: frozenset[str] = frozenset()
    safe: dict[str, float] = field(default_factory=dict)
    write_groups: dict[str, tuple[str, ...]] = field(default_factory=dict)
    """By name: tags that are written whole or not at all, in the order in which they are written."""
    heartbeat: Heartbeat | None = None
    tpdo1: Tpdo | None = None
    start: bool = False
    canopen: CanopenNodeConfig = field(default_factory=CanopenNodeConfig)
    phase: dict[str, int] = field(default_factory=dict)
    timeout_s: float | None = None
    retries: int | None = None
    spacing_s: float = 0.0
    backoff_first_s: float = 0.25
    backoff_limit_s: float = 10.0

    @property
    def where(self) -> str:
        """For messages: device, bus and address."""
        kind = "unit" if self.profile.protocol == "modbus" else "node"
        return f"{self.name} ({self.bus} {kind} {self.address})"
