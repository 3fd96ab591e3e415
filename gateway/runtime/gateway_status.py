"""The status of a gateway: the answer to `get` on the control channel. The gateway and its clients use these classes.

The fields are the keys of the JSON object, in this order. Fields that apply to some buses or devices only are absent
where they do not (`msgspec.UNSET`). This module declares data; `fieldtwin.gateway.runtime.status` fills it.
"""

from __future__ import annotations

from typing import Any

import msgspec
from msgspec import UNSET, UnsetType

Counts = dict[str, int]


class EmcyStatus(msgspec.Struct, frozen=True, kw_only=True):
    """An emergency message of a CANopen node (CiA 301, 7.2.7)."""

    age_ms: int
    code: str
    """Emergency error code, such as ``8130h``."""
    meaning: str
    register: int | None
    """Error register, object 1001h."""
    vendor: str
    """The manufacturer-specific bytes as hex."""


class TpdoStatus(msgspec.Struct, frozen=True, kw_only=True):
    """A transmit PDO of a node, with the frames received so far."""

    cob_id: str
    tags: list[str]
    frames: int


class LatencyStatus(msgspec.Struct, frozen=True, kw_only=True):
    """Response times as counts by bucket. `bounds_ms` are the upper limits; `counts` has one more, for longer times."""

    bounds_ms: list[int]
    counts: list[int]
    total_s: float


class DeviceStatus(msgspec.Struct, frozen=True, kw_only=True):
    """A device as its driver sees it. Counters begin with the gateway."""

    bus: str
    address: int
    """Unit ID or node ID."""
    online: bool
    """Whether the device answers and is the expected one."""
    error: str
    """The reason why the device is not online, or its problem; empty if it has none."""
    identity_error: str
    """The difference between the device and the one in the system file; empty if they do not differ."""
    polls: int
    errors: int
    """The number of polls that failed, and of PDOs that were malformed."""
    samples_missed: int | UnsetType = UNSET
    """For a Modbus device that counts its samples: the number of samples that were replaced before a poll read them."""
    mailbox: bool | UnsetType = UNSET
    conflicts: int | UnsetType = UNSET
    """For a CANopen node: the number of replies from a second node with the same ID."""
    conflict: str | UnsetType = UNSET
    unstarted: str | UnsetType = UNSET
    """For a CANopen node that the gateway does not start: the tags that have no value until a different NMT master starts the
    node.
    """
    boots: int | UnsetType = UNSET
    bring_ups: int | UnsetType = UNSET
    emcys: int | UnsetType = UNSET
    emcy: list[str] | UnsetType = UNSET
    """For a CANopen node: error codes that the node has sent and not reset, such as ``8130h``."""
    emcy_log: list[EmcyStatus] | UnsetType = UNSET
    tpdos: dict[str, TpdoStatus] | UnsetType = UNSET
    """For a CANopen node: its TPDOs, by number."""
    rpdos: dict[str, list[str]] | UnsetType = UNSET
    rpdos_sent: int | UnsetType = UNSET


class BusStatus(msgspec.Struct, frozen=True, kw_only=True):
    """A bus and its connection."""

    endpoint: str
    connected: bool
    opens: int
    """The number of connections that were opened so far."""
    local: list[str]
    """The local addresses of the connections so far."""
    error: str
    """The reason why the bus is not connected; empty while it is connected."""
    counters: Counts
    latency: LatencyStatus
    """Response times: from request to reply (Modbus), and of whole SDO transfers (CANopen)."""
    not_produced: int | UnsetType = UNSET
    """For a CAN bus: the number of SYNC, TIME and repeated RPDO messages that could not be sent in their period."""
    sync_producers: str | UnsetType = UNSET
    """For a CAN bus: the problem with the producers of SYNC; empty if there is none."""


class TagStatus(msgspec.Struct, frozen=True, kw_only=True):
    """A tag's value (bytes as hex) with quality and reason. `age_s` is None if there has been no value."""

    value: bool | int | float | str | None
    quality: str
    reason: str
    age_s: float | None
    text: str | UnsetType = UNSET
    """The name that the profile gives to the present value."""


class OutputStatus(msgspec.Struct, frozen=True, kw_only=True):
    """An output. `wanted` is the value that `by` commands, None without a command; `held` is the value in the device."""

    tag: str
    wanted: bool | int | float | None
    held: bool | int | float | None
    by: str
    refused: bool


class WritesStatus(msgspec.Struct, frozen=True, kw_only=True):
    """Counters of writes. `safe`: whether the outputs have their safe values because the PLC was lost."""

    allowed: bool
    done: int
    failed: int
    refused: int
    repeated: int
    superseded: int
    safe: bool


class RefusalStatus(msgspec.Struct, frozen=True, kw_only=True):
    """A write that did not reach its device (`fieldtwin.gateway.runtime.outputs.refusals.RefusedOutput`). Times are monotonic."""

    number: int
    tag: str
    first: Any
    value: Any
    cause: str
    reason: str
    by: str
    t_ns: int
    last_ns: int
    count: int
    program: str
    place: str
    fault: str
    """The part that has to be corrected: "program" or "device"; "" if neither has to be corrected."""
    standing: bool


class RefusalsStatus(msgspec.Struct, frozen=True, kw_only=True):
    """The journal of writes that did not reach their device (`fieldtwin.gateway.runtime.outputs.refusals`)."""

    total: int
    entries_made: int
    unrecorded: int
    faults: Counts
    """The number of refusals that are a fault of the program ("program") or of the device ("device")."""
    counts: Counts
    entries: list[RefusalStatus]
    """The entries that are kept."""


class MailboxStatus(msgspec.Struct, frozen=True, kw_only=True):
    """Counters of the messages of a transmitter."""

    received: int
    sent: int
    taken: int
    waits: int
    queued: int
    dropped: int
    commands_refused: int


class FrontStatus(msgspec.Struct, frozen=True, kw_only=True):
    """A TCP port or a serial line on which the gateway answers clients."""

    listening: str | None
    """The URL that is open; None while it is not."""
    error: str
    """The reason why it is not open; empty while it is open."""
    counters: Counts
    clients: list[str] = []
    """The connected clients of a TCP port, as HOST:PORT."""


class ServerStatus(FrontStatus, frozen=True, kw_only=True):
    """A server of tags."""

    kind: str = "modbus"
    """The kind of the server, as the `serve` section of the system file names it."""
    unit: int | UnsetType = UNSET
    """For a Modbus server: the unit ID for which it answers."""


class BridgeStatus(FrontStatus, frozen=True, kw_only=True):
    """A bridge to the units of buses."""

    away: list[str]
    """The units that did not answer and get no requests for a time, as BUS/UNIT."""


class LearntStatus(msgspec.Struct, frozen=True, kw_only=True):
    """Addresses at which a device refuses reads, as the gateway has found by polling it; see `learnt_gaps`."""

    profile: str
    gaps: list[str]
    borders: list[str]
    missing: list[str]
    """Tags that the device does not have."""
    line: str
    """The line that replaces the `gaps` in the profile; "" if the profile needs no change."""


class PlcSeen(msgspec.Struct, frozen=True, kw_only=True):
    """The PLC as the gateway sees it in the process image. `age_ms` is None if it has never published."""

    alive: bool
    age_ms: float | None
    losses: int
    stopped: bool


class AlarmStatus(msgspec.Struct, frozen=True, kw_only=True):
    """An alarm of the alarm list.

    `state` is one of `fieldtwin.gateway.runtime.alarms.state_machine.ALARM_STATES`. `active` is its condition after the delays.
    """

    state: str
    active: bool
    quality: str
    """Bad if the condition is unknown; the alarm then keeps its state."""
    reason: str
    priority: str
    text: str
    condition: str
    acknowledge: bool
    """Whether the alarm needs an acknowledgement."""
    by: str
    """The user whose action caused the last change; empty if the condition did."""
    in_state_s: float | None
    """The seconds since the last change of the state; None if it has not changed."""
    shelved_for_s: float | None
    """The seconds until shelving ends; None if the alarm is not shelved."""


class AlarmEvent(msgspec.Struct, frozen=True, kw_only=True):
    """A change of an alarm: its number, monotonic time (ns) and name, and state, condition, quality and reason after it."""

    number: int
    t_ns: int
    name: str
    state: str
    active: bool
    quality: str
    reason: str
    by: str
    """The user whose action it was; empty if the condition caused the change."""


class ConfigStatus(msgspec.Struct, frozen=True, kw_only=True):
    """The files that the gateway has applied: name and hash of the system, number of reloads, and changes of the last reload."""

    system: str
    hash: str
    reloads: int
    changed: list[str]


class GatewayStatus(msgspec.Struct, frozen=True, kw_only=True):
    """The status of a gateway."""

    devices: dict[str, DeviceStatus]
    buses: dict[str, BusStatus]
    tags: dict[str, TagStatus]
    """All tags; none in a brief status, which a client gets with ``"brief": true``."""
    outputs: list[OutputStatus]
    writes: WritesStatus
    refusals: RefusalsStatus
    mailboxes: dict[str, MailboxStatus]
    plc: PlcSeen
    serve: dict[str, ServerStatus]
    bridge: dict[str, BridgeStatus]
    published: int
    logged: int
    log_dropped: int
    learnt: dict[str, LearntStatus] = {}
    """By device: the gaps that the gateway has found."""
    alarms: dict[str, AlarmStatus] = {}
    """The alarm list, in the order of the system file."""
    store_error: str = ""
    config: ConfigStatus | UnsetType = UNSET


class StoppedGateway(msgspec.Struct, frozen=True, kw_only=True):
    """The answer to `stop`: whether the devices confirmed their safe values, and the final status."""

    safe: bool
    status: GatewayStatus
