"""The status of the field simulator on the control channel: the answer to `get`, used by the sender and the receivers of the
answer.

The fields are the keys of the JSON object, in this order. A field that later versions add has a default, so that an
older field simulator in another container can still be read. This module must not import emulators: a run of a plant
has none.
"""

from __future__ import annotations

from typing import Any

import msgspec

Counts = dict[str, int]


class SimulatedDeviceStatus(msgspec.Struct, frozen=True, kw_only=True):
    """One simulated device. Counters begin with 0 when the device is created."""

    profile: str
    recording: str
    """The recording, simulation or model that gives the device its values; "None" if it has none."""
    plays: str
    """The same data source, as a sentence for the user."""
    remarks: list[str] = []
    """Differences from a node's data sheet."""
    commands: list[str] = []
    executed: Counts = {}
    """The number of executions of each command."""
    unlisted: int = 0
    """The number of requests that are not in the device's list of commands."""
    counters: Counts = {}
    held: int = 0
    """The number of values that the device has held so far."""
    held_dropped: int = 0
    """The number of those values that were dropped from the journal."""


class ActiveFaultStatus(msgspec.Struct, frozen=True, kw_only=True):
    """A fault that is injected now. `bus` or `device` is empty if the fault is not aimed at one."""

    id: str
    name: str
    bus: str
    device: str
    struck: int
    """Number of times that the fault took effect."""


class StruckStatus(msgspec.Struct, frozen=True, kw_only=True):
    """A fault that was injected, and the number of times that it took effect."""

    number: int
    """The position of this fault among all faults that were injected into these devices, from 1."""
    id: str
    name: str
    on: str
    """The device or bus into which the fault was injected."""
    struck: int
    optional: bool
    """Whether a scenario may pass although the fault never took effect."""


class HeldLease(msgspec.Struct, frozen=True, kw_only=True):
    """The lease of a test runner: its faults and the values that it has set, by DEVICE.TAG, are removed when it ends."""

    id: str
    left_s: float
    faults: list[str]
    set: list[str]


class LeaseStatus(msgspec.Struct, frozen=True, kw_only=True):
    """The present lease, and the number of leases that ended because they were not prolonged."""

    held: HeldLease | None = None
    expired: int = 0


class FieldStatus(msgspec.Struct, frozen=True, kw_only=True):
    """All simulated devices of a system, and the faults on them."""

    life: str = ""
    """The identity of these devices. Devices that are created again have a different identity."""
    system: str
    system_hash: str
    devices: dict[str, SimulatedDeviceStatus]
    clients: dict[str, dict[str, Counts]] = {}
    """The requests that reached a device, and the replies, by bus and client."""
    faults: list[ActiveFaultStatus] = []
    struck: list[StruckStatus] = []
    """Every fault so far, in the order of injection."""
    listening: dict[str, str] = {}
    """The URL at which the simulated devices of each bus listen."""
    far: dict[str, str] = {}
    """The URL of the remote modem of each transmitter."""
    links: dict[str, Counts] = {}
    """The messages sent, sent again and delivered over the modems' link, for each transmitter."""
    buses: dict[str, dict[str, Any]] = {}
    """The statistics of each CAN bus that this process serves, by URL (`SoftBusServer.bus_stats`)."""
    set: dict[str, float] = {}
    """The values that were set by hand or by a test, by DEVICE.TAG."""
    lease: LeaseStatus = LeaseStatus()
    failures: dict[str, str] = {}
    """The devices that fell silent because their simulation has failed, with the error."""
