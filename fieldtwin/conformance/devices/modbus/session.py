"""A complete check of a Modbus device: connect, learn its normal answers, read its identity, run the cases."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AsyncExitStack
from dataclasses import dataclass, field

from fieldtwin.commissioning.access.connection import bytes_at
from fieldtwin.conformance.core.case import CasePlan
from fieldtwin.conformance.devices.checked import Checked, shown
from fieldtwin.conformance.devices.device_case import DeviceResult
from fieldtwin.conformance.devices.modbus.cases import CASES
from fieldtwin.conformance.devices.modbus.connection import DeviceConnection
from fieldtwin.conformance.devices.modbus.learn import learn
from fieldtwin.conformance.devices.run import Transcript, play
from fieldtwin.gateway.core.clock import NS_PER_S, Clock
from fieldtwin.gateway.core.connection import ByteConnection, Connector, Tap
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import NotAllowed
from fieldtwin.gateway.protocols.modbus.frames.selection import framing_of
from fieldtwin.gateway.wallclock import WallClock

OBJECT_NAMES = {
    0: "vendor",
    1: "product code",
    2: "revision",
    3: "vendor URL",
    4: "product",
    5: "model",
    6: "application",
}
"""AP 6.21, table of object ids."""


@dataclass(frozen=True, slots=True)
class ModbusOptions:
    """The options of a check.

    `given` table -> address that can be read; `may_write` table -> (address, count) of cells that may be written
    temporarily; `go_on` returns the reason to stop sending, or an empty string. A serial line is first observed for
    `listen_s` seconds: nothing is sent if other devices communicate on it, unless `share_bus`.
    """

    endpoint: str
    unit: int
    plan: CasePlan
    timeout_s: float = 1.0
    spacing_s: float = 0.05
    echo: bool = False
    listen_s: float = 1.0
    share_bus: bool = False
    given: dict[str, int] = field(default_factory=dict)
    may_write: dict[str, tuple[int, int]] = field(default_factory=dict)
    taps: Sequence[Tap] = ()
    connector: Connector | None = None
    clock: Clock | None = None
    go_on: Callable[[], str] = lambda: ""


def traits_of(endpoint: Endpoint) -> frozenset[str]:
    """Return the names of the transport in cases: ``rtu-line``, ``ascii-line``, ``rtu-stream``, ``mbap-stream``, ``udp``."""
    framing = framing_of(endpoint)
    if framing == "udp":
        return frozenset({"udp"})
    kind = "line" if endpoint.is_serial else "stream"
    return frozenset({f"{framing}-{kind}"} | ({"serial"} if endpoint.is_serial else set()))


async def check_modbus(
    options: ModbusOptions,
    print_line: Callable[[str], None] = lambda text: None,
    on_result: Callable[[DeviceResult], None] = lambda result: None,
) -> Checked:
    """Run the whole check. Raises `Unreachable` if the device does not answer, `NotAllowed` if the serial line carries
    other traffic.
    """
    endpoint = Endpoint.parse(options.endpoint)
    clock = options.clock or WallClock()
    began_ns = clock.monotonic_ns()
    transcript = Transcript(clock)
    async with AsyncExitStack() as opened:

        async def open_wire() -> ByteConnection:
            taps = (transcript, *options.taps)
            return await opened.enter_async_context(
                bytes_at(options.endpoint, taps=taps, connector=options.connector, clock=clock)
            )

        wire = DeviceConnection(
            open_wire, clock, framing_of(endpoint), options.unit, traits=traits_of(endpoint), timeout_s=options.timeout_s,
            spacing_s=options.spacing_s, char_s=endpoint.serial.char_time_s if endpoint.is_serial else 0.0, echo=options.echo,
        )  # fmt: skip
        wire.may_write = dict(options.may_write)
        if endpoint.is_serial and options.listen_s and not options.share_bus:
            await wire.reopen()
            heard = await wire.hear(0, options.listen_s)
            if not heard.nothing:
                raise NotAllowed(
                    "this line carries other traffic",
                    got=str(heard)[:60],
                    hint="--share-bus runs the check all the same",
                )
        await learn(wire, options.given, {table: at for table, (at, _) in options.may_write.items()})
        print_line(f"the usual request is {wire.good.hex(' ').upper()}, its answer {wire.good_reply.hex(' ').upper()}")
        identity = await read_identity(wire)
        before = transcript.spoken
        results = await play(wire, CASES, options.plan, transcript, clock, on_result, options.go_on)
        await wire.aclose()
    return Checked(identity, results, before, (clock.monotonic_ns() - began_ns) / NS_PER_S)


async def read_identity(wire: DeviceConnection) -> dict[str, str]:
    """Return the device's identification by FC 43/14 and FC 17; empty if it gives none."""
    identity: dict[str, str] = {}
    for code in (0x01, 0x02):
        answer = (await wire.ask(bytes((0x2B, 0x0E, code, 0)), due=False)).first
        if answer is None or answer.refusal:
            break
        identity |= objects_in(answer.pdu)
    answer = (await wire.ask(b"\x11", due=False)).first
    if answer is not None and not answer.refusal and len(answer.pdu) > 2:
        identity["server id"] = shown(answer.pdu[2:]) or answer.pdu[2:].hex(" ").upper()
    await wire.settle()
    return identity


def objects_in(pdu: bytes) -> dict[str, str]:
    """Return the objects in a reply of FC 43/14, name to text; empty for any other PDU."""
    said: dict[str, str] = {}
    if len(pdu) < 7 or pdu[:2] != b"\x2b\x0e":
        return said
    place = 7
    while place + 2 <= len(pdu):
        name = OBJECT_NAMES.get(pdu[place], f"object {pdu[place]:02X}")
        if text := shown(pdu[place + 2 : place + 2 + pdu[place + 1]]):
            said[name] = text
        place += 2 + pdu[place + 1]
    return said
