"""A complete check of a CANopen node: listen to the bus, read the node's identity, find a long object, run the cases."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from fieldtwin.commissioning.access.connection import frames_at
from fieldtwin.conformance.core.case import CasePlan
from fieldtwin.conformance.devices.canopen.cases import CASES
from fieldtwin.conformance.devices.canopen.connection import SDO_REQUEST, Key, NodeConnection, SdoReply
from fieldtwin.conformance.devices.checked import Checked, shown
from fieldtwin.conformance.devices.device_case import DeviceResult
from fieldtwin.conformance.devices.run import Transcript, play
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.clock import NS_PER_S, Clock
from fieldtwin.gateway.core.connection import Connector, Direction, Tap
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import NotAllowed, Unreachable
from fieldtwin.gateway.protocols.canopen.eds.dictionary import load_dictionary
from fieldtwin.gateway.wallclock import WallClock

NAMES = {(0x1008, 0): "name", (0x1009, 0): "hardware", (0x100A, 0): "software"}
NUMBERS = {1: "vendor id", 2: "product code", 3: "revision", 4: "serial number"}
LISTEN_S = 0.5
"""Time in seconds for which the check listens before it sends anything: a heartbeat in this time reports the node's NMT state."""
MOST_LONG = 20
"""Largest number of objects of the EDS that are read to find one with more than one segment."""
MOST_BYTES = 5_000
"""Largest size in bytes of the object with which transfers are checked. CO-016 uploads it in at most 200 blocks of 28 bytes."""


@dataclass(frozen=True, slots=True)
class CanopenOptions:
    """The options of a check: `may_write` are objects that may be written temporarily; `go_on` as in `ModbusOptions`.

    Nothing is sent if another master exchanges SDOs with the node, unless `share_bus`, because the check would disturb the
    transfers of that master.
    """

    endpoint: str
    node: int
    plan: CasePlan
    bitrate: int = 0
    timeout_s: float = 0.5
    spacing_s: float = 0.02
    boot_s: float = 10.0
    eds: Path | None = None
    share_bus: bool = False
    may_write: tuple[Key, ...] = ()
    taps: Sequence[Tap] = ()
    connector: Connector | None = None
    clock: Clock | None = None
    go_on: Callable[[], str] = lambda: ""


class _OfTheNode(Transcript):
    """A transcript of the frames that the check sends and of those from the node, without the frames of other nodes on the
    bus.
    """

    def __init__(self, clock: Clock, node: int) -> None:
        super().__init__(clock)
        self._node = node

    def on_frame(self, endpoint: Endpoint, direction: Direction, t_ns: int, frame: CanFrame) -> None:
        if direction is Direction.SENT or frame.extended or frame.can_id == 0x7E4 or frame.can_id & 0x7F == self._node:
            super().on_frame(endpoint, direction, t_ns, frame)


async def check_canopen(
    options: CanopenOptions,
    print_line: Callable[[str], None] = lambda text: None,
    on_result: Callable[[DeviceResult], None] = lambda result: None,
) -> Checked:
    """Run the whole check.

    Raises `Unreachable` if the node does not answer, `NotAllowed` if another master exchanges SDOs with the node.
    """
    dictionary = load_dictionary(options.eds, options.node) if options.eds is not None else None
    clock = options.clock or WallClock()
    began_ns = clock.monotonic_ns()
    transcript = _OfTheNode(clock, options.node)
    taps = (transcript, *options.taps)
    async with frames_at(
        options.endpoint, options.bitrate, taps=taps, connector=options.connector, clock=clock
    ) as connection:
        wire = NodeConnection(
            connection, clock, options.node, timeout_s=options.timeout_s, spacing_s=options.spacing_s, boot_s=options.boot_s,
            may_write=options.may_write, dictionary=dictionary,
        )  # fmt: skip
        heard = await wire.listen(LISTEN_S)
        if not options.share_bus and any(f.can_id == SDO_REQUEST + options.node and not f.extended for f in heard):
            raise NotAllowed(
                f"another master uses SDO with node {options.node}", hint="--share-bus runs the check all the same"
            )
        identity = await learn(wire)
        print_line(f"1000h is {wire.device_type.hex(' ').upper()}")
        before = transcript.spoken
        results = await play(wire, CASES, options.plan, transcript, clock, on_result, options.go_on)
    return Checked(identity, results, before, (clock.monotonic_ns() - began_ns) / NS_PER_S)


async def learn(wire: NodeConnection) -> dict[str, str]:
    """Read the device type and identity, and find an object of several segments. Raises `Unreachable` if 1000h cannot be read."""
    found: bytes | SdoReply = SdoReply()
    for _ in range(2):  # a single missing answer may be caused by a lost frame
        found = await wire.upload((0x1000, 0))
        if isinstance(found, bytes):
            break
    if isinstance(found, SdoReply):
        if found.abort:
            raise Unreachable(f"node {wire.node} has no 1000h: {found}", hint="every CANopen node has one (7.5.2.1)")
        stopped = "; its heartbeat reports STOPPED: start it first" if wire.state == 0x04 else ""
        raise Unreachable(f"node {wire.node} does not answer SDO{stopped}", hint="check the node ID and the bit rate")
    wire.device_type = found
    identity = {"device type": f"{int.from_bytes(found, 'little'):08X}h"}
    for sub, name in NUMBERS.items():
        value = await wire.upload((0x1018, sub))
        if isinstance(value, bytes):
            identity[name] = f"{int.from_bytes(value, 'little')} ({int.from_bytes(value, 'little'):08X}h)"
    longest = 7
    for key, name in NAMES.items():
        value = await wire.upload(key)
        if isinstance(value, bytes):
            if text := shown(value):
                identity[name] = text
            if longest < len(value) <= MOST_BYTES:
                wire.long, longest = key, len(value)
    if wire.long is None:
        wire.long = await _long_by_eds(wire)
    return identity


async def _long_by_eds(wire: NodeConnection) -> Key | None:
    """Return an object of the EDS that holds more than 7 bytes and at most `MOST_BYTES`, None if none was found."""
    texts = [e for e in wire.dictionary or () if e.readable and e.type_code in (0x09, 0x0A, 0x0B, 0x0F)]
    for entry in texts[:MOST_LONG]:
        key = (entry.index, entry.subindex)
        value = await wire.upload(key)
        if isinstance(value, bytes) and 7 < len(value) <= MOST_BYTES:
            return key
    return None
