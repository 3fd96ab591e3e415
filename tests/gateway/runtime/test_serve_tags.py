"""The process image as Modbus TCP registers: values of good, bad and uncertain tags, and permitted writes."""

from __future__ import annotations

import math
import struct
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support import eventually, run

from fieldtwin.gateway.connections.sockets.tcp import TcpConnection
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import (
    EndpointBusy,
    FieldtwinError,
    FileInvalid,
    ModbusExceptionReply,
    NotAllowed,
    Unreachable,
)
from fieldtwin.gateway.core.values import Quality, Reason, Scalar, TagValue
from fieldtwin.gateway.protocols.modbus.client import ModbusClient
from fieldtwin.gateway.runtime.bridge.tcp import Caller
from fieldtwin.gateway.runtime.serve import ServeConfig, ServedTag, TagServer
from fieldtwin.gateway.runtime.serve_codec import FORMATS, pack, unpack
from fieldtwin.gateway.runtime.tags import TagTable
from fieldtwin.gateway.wallclock import WallClock
from fieldtwin.twin.site.system import load_system

CLOCK = WallClock()
TAGS = (
    ServedTag("d.pressure", "input", 0, quality_at=2),
    ServedTag("d.depth", "input", 4, order="CDAB"),
    ServedTag("d.count", "input", 6, "uint16"),
    ServedTag("d.open", "discrete", 9, "bool"),
    ServedTag("d.period", "holding", 0, "int16", write=True),
    ServedTag("d.locked", "holding", 1, "int16"),
    ServedTag("d.valve", "coil", 3, "bool", write=True),
)


class Writes:
    """Accept writes and let the test decide how they end."""

    def __init__(self) -> None:
        self.asked: list[tuple[str, float, str]] = []
        self.error: FieldtwinError | None = None

    def request(self, tag: str, value: float, by: str, done: Callable[[FieldtwinError | None], None]) -> None:
        self.asked.append((tag, value, by))
        done(self.error)


class Served:
    def __init__(self, server: TagServer, tags: TagTable, writes: Writes, client: ModbusClient) -> None:
        self.server, self.tags, self.writes, self.client = server, tags, writes, client

    def put(
        self, name: str, value: Scalar | None, quality: Quality = Quality.GOOD, reason: Reason = Reason.NONE
    ) -> None:
        self.tags.put(f"d.{name}", TagValue(value, quality, reason, CLOCK.monotonic_ns()))

    async def code(self, what: Callable[[ModbusClient], object]) -> int:
        with pytest.raises(ModbusExceptionReply) as caught:
            await what(self.client)  # type: ignore[misc]
        return caught.value.code


@asynccontextmanager
async def served(if_bad: str = "exception") -> AsyncIterator[Served]:
    tags = TagTable(CLOCK)
    tags.declare([t.tag for t in TAGS], 60_000)
    writes = Writes()
    config = ServeConfig("hmi", Endpoint.parse("tcp://127.0.0.1:0"), 1, TAGS, if_bad)  # type: ignore[arg-type]
    server = TagServer(config, tags, writes, CLOCK)
    async with Nursery() as nursery:
        nursery.start(server.run(), "server")
        await eventually(lambda: server.front.bound is not None)
        assert server.front.bound is not None
        client = ModbusClient(await TcpConnection.open(server.front.bound), CLOCK, framing="mbap")
        made = Served(server, tags, writes, client)
        for name, value in (("pressure", 1.5), ("depth", 1.5), ("count", 7), ("open", True), ("period", -2)):
            made.put(name, value)
        made.put("valve", False)
        try:
            yield made
        finally:
            await client.aclose()


def test_good_values_in_their_types_and_orders() -> None:
    async def main() -> None:
        async with served() as s:
            assert (await s.client.read_registers(1, "input", 0, 3)).raw == struct.pack(">f", 1.5) + b"\0\0"
            assert (await s.client.read_registers(1, "input", 4, 3)).raw == bytes.fromhex("0000 3FC0 0007")
            assert (await s.client.read_registers(1, "holding", 0, 1)).raw == struct.pack(">h", -2)
            assert (await s.client.read_bits(1, "discrete", 9, 1)).bits == (True,)
            assert (await s.client.read_bits(1, "coil", 3, 1)).bits == (False,)
            for unit in (0, 255):  # MB-057
                assert (await s.client.read_registers(unit, "input", 6, 1)).registers == (7,)
            assert await s.code(lambda c: c.read_registers(2, "input", 6, 1)) == 0x0A

    run(main())


def test_a_bad_value_never_looks_good() -> None:
    async def main() -> None:
        async with served() as s:
            s.put("pressure", 1.5, Quality.BAD, Reason.TIMEOUT)
            assert await s.code(lambda c: c.read_registers(1, "input", 0, 2)) == 4
            assert await s.code(lambda c: c.read_registers(1, "input", 0, 3)) == 4
            word = (await s.client.read_registers(1, "input", 2, 1)).registers[0]
            assert word == Quality.BAD << 8 | Reason.TIMEOUT
            s.put("open", None, Quality.BAD, Reason.NEVER_READ)
            assert await s.code(lambda c: c.read_bits(1, "discrete", 9, 1)) == 4
            assert (await s.client.read_registers(1, "input", 6, 1)).registers == (7,)  # the others remain
            assert s.server.counters.bad == 3

    run(main())


def test_nan_is_served_if_the_file_specifies_it() -> None:
    async def main() -> None:
        async with served("nan") as s:
            s.put("pressure", 1.5, Quality.BAD, Reason.STALE)
            reply = await s.client.read_registers(1, "input", 0, 3)
            assert math.isnan(struct.unpack(">f", reply.raw[:4])[0])
            assert reply.registers[2] == Quality.BAD << 8 | Reason.STALE
            s.put("count", 3, Quality.BAD, Reason.TIMEOUT)  # an integer has no NaN
            assert await s.code(lambda c: c.read_registers(1, "input", 6, 1)) == 4

    run(main())


def test_uncertain_values_are_served_only_with_a_quality_register() -> None:
    async def main() -> None:
        async with served() as s:
            for name in ("pressure", "depth"):
                s.put(name, 9.0, Quality.UNCERTAIN, Reason.NOT_SAMPLING)
            reply = await s.client.read_registers(1, "input", 0, 3)
            assert struct.unpack(">f", reply.raw[:4])[0] == 9.0
            assert reply.registers[2] == Quality.UNCERTAIN << 8 | Reason.NOT_SAMPLING
            assert await s.code(lambda c: c.read_registers(1, "input", 4, 2)) == 4

    run(main())


def test_a_value_that_does_not_fit_its_type_is_bad() -> None:
    async def main() -> None:
        async with served() as s:
            s.put("count", 65536)
            assert await s.code(lambda c: c.read_registers(1, "input", 6, 1)) == 4

    run(main())


def test_half_a_value_and_gaps_do_not_exist() -> None:
    async def main() -> None:
        async with served() as s:
            for address, count in ((0, 1), (1, 1), (1, 2), (3, 1), (6, 2), (65535, 1)):
                assert await s.code(lambda c, a=address, n=count: c.read_registers(1, "input", a, n)) == 2  # type: ignore[misc]
            assert await s.code(lambda c: c.read_bits(1, "discrete", 8, 2)) == 2

    run(main())


def test_a_write_is_passed_on_with_its_requester() -> None:
    async def main() -> None:
        async with served() as s:
            await s.client.write_register(1, 0, 0xFFFF)
            await s.client.write_registers(1, 0, [5])
            await s.client.write_coil(1, 3, True)
            await s.client.write_coils(1, 3, [False])
            assert [(tag, value) for tag, value, _ in s.writes.asked] == [
                ("d.period", -1),
                ("d.period", 5),
                ("d.valve", 1),
                ("d.valve", 0),
            ]
            assert all(by.startswith("127.0.0.1:") for _, _, by in s.writes.asked)

    run(main())


def test_an_impossible_write_is_refused_and_not_passed_on() -> None:
    async def main() -> None:
        async with served() as s:
            assert await s.code(lambda c: c.write_register(1, 1, 5)) == 2  # served, not writable
            assert await s.code(lambda c: c.write_register(1, 7, 5)) == 2
            assert await s.code(lambda c: c.write_registers(1, 0, [1, 2])) == 2
            assert await s.code(lambda c: c.mask_write(1, 0, 0, 1)) == 1
            assert s.writes.asked == []
            readers = ServeConfig("r", Endpoint.parse("tcp://127.0.0.1:0"), 1, TAGS[:4])
            server = TagServer(readers, s.tags, s.writes, CLOCK)
            assert server.ask(Caller("x", "x"), 1, bytes.fromhex("06 0000 0001")) == b"\x86\x01"

    run(main())


@pytest.mark.parametrize(
    ("error", "code"), [(NotAllowed("limits"), 3), (EndpointBusy("twice"), 6), (Unreachable("away"), 4)]
)
def test_the_client_gets_the_result_of_its_write(error: FieldtwinError, code: int) -> None:
    async def main() -> None:
        async with served() as s:
            s.writes.error = error
            assert await s.code(lambda c: c.write_register(1, 0, 5)) == code

    run(main())


@given(
    kind=st.sampled_from(sorted(FORMATS)),
    order=st.sampled_from(["ABCD", "CDAB", "BADC", "DCBA"]),
    value=st.one_of(st.floats(), st.integers(-(2**70), 2**70), st.booleans(), st.none(), st.text(max_size=3)),
)
def test_a_served_value_is_the_tags_value_or_none(kind: str, order: str, value: Scalar | None) -> None:
    data = pack(kind, order, value)
    if data is None:
        return
    assert len(data) == struct.calcsize(FORMATS[kind])
    back = unpack(kind, order, data)
    assert back is not None
    assert isinstance(value, int | float)
    match kind:
        case "bool":
            assert back == bool(value)
        case "float32":
            assert back == struct.unpack(">f", struct.pack(">f", value))[0]
        case "float64":
            assert back == float(value)
        case _:
            assert back == round(value)


# -- the file --------------------------------------------------------------------------------------------------------------

SYSTEM = (Path(__file__).resolve().parents[3] / "profiles" / "systems" / "observatory.yaml").read_text(encoding="utf-8")
HMI = 'serve:\n  hmi:\n    url: "tcp://127.0.0.1:0"\n    tags:\n'
DOOR = 'bridge:\n  door:\n    url: "tcp://127.0.0.1:0"\n'


def without_sections(text: str) -> str:
    kept, keep = [], True
    for line in text.splitlines():
        if line and not line[0].isspace():
            keep = not line.startswith(("serve:", "bridge:"))
        if keep:
            kept.append(line)
    return "\n".join(kept) + "\n"


def load(tmp_path: Path, section: str) -> object:
    path = tmp_path / "system.yaml"
    path.write_text(without_sections(SYSTEM) + section, encoding="utf-8")
    return load_system(str(path)).serving


@pytest.mark.parametrize(
    ("section", "says"),
    [
        (HMI + "      ctd.pressure: {input: 0}\n      ctd.temperature: {input: 1}\n", "overlaps ctd.pressure"),
        (HMI + "      ctd.pressure: {input: 0, quality: 1}\n", "overlaps"),
        (HMI + "      ctd.pressur: {input: 0}\n", "did you mean 'pressure'"),
        (HMI + "      ctd.pressure: {type: float32}\n", "has no table"),
        (HMI + "      ctd.pressure: {input: 65535}\n", "after the last"),
        (HMI + "      ctd.pressure: {discrete: 0, type: float32}\n", "is a bool"),
        (HMI + "      ctd.serial: {input: 0}\n", "is text"),
        (HMI + "      ctd.sample_period_s: {holding: 0, write: true}\n", "one writer per tag"),
        (HMI + "      ctd.pressure: {input: 0, write: true}\n", "cannot be written"),
        (HMI + "      ctd.pressure: {inpt: 0}\n", "did you mean 'input'"),
        (DOOR, "this bridge has no target"),
        (DOOR + "    to: line2\n", "no Modbus bus 'line2'"),
        (DOOR + "    to: can0\n", "no Modbus bus 'can0'"),
        (DOOR + "    units: {11: line1}\n", "a route"),
        (DOOR + "    to: line1\n    allow: [{from: [10.0.0.300]}]\n", "a network of clients"),
        (DOOR + "    to: line1\n    allow: [{addresses: {holding: [9..1]}}]\n", "the last one"),
        (DOOR + "    to: line1\n    allow: [{functions: [128]}]\n", "function code"),
    ],
)
def test_a_wrong_section_is_refused_with_its_line(tmp_path: Path, section: str, says: str) -> None:
    with pytest.raises(FileInvalid) as caught:
        load(tmp_path, section)
    assert says in str(caught.value)
    assert caught.value.line > len(without_sections(SYSTEM).splitlines())


def test_the_two_sections_of_a_right_file(tmp_path: Path) -> None:
    serving = load(
        tmp_path,
        HMI + "      ctd.pressure: {input: 0, quality: 2}\n      ctd.sample_count: {input: 4}\n"
        "bridge:\n  door:\n    url: 'tcp://127.0.0.1:0'\n    to: line1\n    units: {11: lan/1}\n"
        "    allow: [{from: [10.0.0.0/24], units: ['1..3', 11], functions: [read, 6], addresses: {holding: ['0..9']}}]\n",
    )
    (server,), (bridge,) = serving.serve, serving.bridges  # type: ignore[attr-defined]
    first = server.tags[0]
    assert (first.tag, first.table, first.address, first.count, first.quality_at) == ("ctd.pressure", "input", 0, 2, 2)
    assert server.tags[1].type == "uint32"
    assert bridge.buses == {"line1", "lan"}
    (rule,) = bridge.policy.rules
    assert rule.units == {1, 2, 3, 11}
    assert 6 in rule.functions
    assert rule.addresses == {"holding": ((0, 9),)}
    assert not bridge.policy.allow_writes
    for read_only, writes in (((), True), (("ctd0",), True), (("lan",), False)):  # a real bus of a prototype
        (bridge,) = serving.for_run(allow_writes=True, read_only=read_only, free_ports=True).bridges  # type: ignore[attr-defined]
        assert bridge.policy.allow_writes is writes
