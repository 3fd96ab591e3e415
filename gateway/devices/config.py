"""The configuration of buses and devices: immutable, with all defaults filled in, and without information about emulators."""

from __future__ import annotations

from dataclasses import dataclass, field

from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.files.profile import DeviceProfile
from fieldtwin.gateway.devices.canopen_config import CanopenBusConfig, CanopenNodeConfig


@dataclass(frozen=True)
class BusConfig:
    """A bus and its endpoint in the plant. `bitrate` (bit/s) is for CAN only; the fields after it are for Modbus.

    `spacing_s` is a pause after every exchange, `turnaround_s` a pause after a broadcast, `connect_pause_s` a pause after the
    connection was opened. `echo` says that the adapter returns the bytes sent. `strict` applies the RTU silences of SL 2.5.1.1.
    `probe_share` limits the share of the bus's time that is spent on devices that do not answer, as long as other devices do.
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
    """CANopen heartbeat times in milliseconds: the node's producer time and the gateway's consumer time.

    If `producer_ms` is None, the gateway does not change the node's producer time (1017h) and only listens.
    """

    producer_ms: int | None
    consumer_ms: int


@dataclass(frozen=True)
class Tpdo:
    """The tags that TPDO1 of a node has to carry, and its event timer in milliseconds."""

    tags: tuple[str, ...]
    event_ms: int


@dataclass(frozen=True)
class DeviceConfig:
    """A device of the system. `address` is the Modbus unit ID (1 to 255) or the CANopen node ID (1 to 127).

    `poll` gives each group's period in milliseconds; a group without one is read once after connecting. `phase` is the offset
    within its period at which a group is read, in milliseconds; the other groups are spread evenly. `timeout_s` and `retries`
    replace the settings of the bus unless they are None. `spacing_s` is the pause that the device needs after each exchange. If a
    device does not answer, the gateway sends it no request for `backoff_first_s`, then for twice as long each time, up to
    `backoff_limit_s`. `writable` holds the tags that the system file allows to be written, and `safe` the values that are written
    when the controller is lost.
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
    """By group name: tags that are written together or not at all, in the order in which they are written."""
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
        """Return device, bus and address, for messages."""
        kind = "unit" if self.profile.protocol == "modbus" else "node"
        return f"{self.name} ({self.bus} {kind} {self.address})"
