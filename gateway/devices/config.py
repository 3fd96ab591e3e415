"""What the gateway is told about its buses and devices: frozen, resolved, without a word on what is emulated."""

from __future__ import annotations

from dataclasses import dataclass, field

from gateway.core.endpoint import Endpoint
from gateway.core.profile import DeviceProfile
from gateway.devices.canopen_config import CanopenBusConfig, CanopenNodeConfig


@dataclass(frozen=True)
class BusConfig:
    """A bus and the plant's endpoint of it. `bitrate` (bit/s) is for CAN only."""

    name: str
    endpoint: Endpoint
    timeout_s: float = 1.0
    retries: int = 1
    bitrate: int = 125_000
    canopen: CanopenBusConfig = CanopenBusConfig()


@dataclass(frozen=True)
class Heartbeat:
    """CANopen heartbeat times in milliseconds: the node's producer time and our consumer time."""

    producer_ms: int
    consumer_ms: int


@dataclass(frozen=True)
class Tpdo:
    """The tags that TPDO1 of a node shall carry, and its event timer in milliseconds."""

    tags: tuple[str, ...]
    event_ms: int


@dataclass(frozen=True)
class DeviceConfig:
    """A device of the system. `address` is the Modbus unit id (1 to 255) or the CANopen node id (1 to 127).

    `poll` gives each group's period in milliseconds; a group without one is read once after connecting. `writable`
    and `safe` are what the system file allows to be written, and what is written when the controller is lost.
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
    heartbeat: Heartbeat | None = None
    tpdo1: Tpdo | None = None
    start: bool = False
    canopen: CanopenNodeConfig = CanopenNodeConfig()

    @property
    def where(self) -> str:
        """For messages: device, bus and address."""
        kind = "unit" if self.profile.protocol == "modbus" else "node"
        return f"{self.name} ({self.bus} {kind} {self.address})"
