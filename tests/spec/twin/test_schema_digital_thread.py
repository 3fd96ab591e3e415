"""Schemas DigitalThreadProcess, PT-/DTDigitalThreadProcess, PTtoDTConnection, DTtoPTConnection, DigitalThread."""

from __future__ import annotations

import inspect
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from spec_rig import CLOCK, observatory
from support import run

from fieldtwin.gateway.connections.os_connector import OsConnector
from fieldtwin.gateway.core.errors import Bug
from fieldtwin.gateway.core.statemachine import encode_period
from fieldtwin.gateway.core.values import COMMAND, DATA, RESPONSE, Quality, Reason, TagValue
from fieldtwin.gateway.devices.config import BusConfig
from fieldtwin.gateway.devices.transmitter import TransmitterDriver
from fieldtwin.gateway.store.event import Kind
from fieldtwin.gateway.store.sqlite_knowledge import SqliteKnowledge, in_place
from fieldtwin.twin.model.knowledge import KnowledgeWriter
from fieldtwin.twin.model.status import decode_status, encode_status
from fieldtwin.twin.model.thread_process import DigitalThreadProcess, DTDigitalThreadProcess, PTDigitalThreadProcess
from fieldtwin.twin.thread.end import ThreadEnd
from fieldtwin.twin.thread.modem import ModemCarrier
from fieldtwin.twin.thread.thread import DigitalThread, DTtoPTConnection, Operator, PTtoDTConnection, schema_of


def modem() -> ModemCarrier:
    """A carrier over the observatory's own transmitter."""
    system, _ = observatory()
    device = system.devices["modem"]
    bus: BusConfig = system.buses[device.bus]
    return ModemCarrier(device, bus, OsConnector(), CLOCK, [schema_of(system)])


@asynccontextmanager
async def end(folder: Path, name: str) -> AsyncIterator[tuple[ThreadEnd, KnowledgeWriter, SqliteKnowledge]]:
    store = await SqliteKnowledge.open(folder / f"{name}.db", offload=in_place)
    origin = await store.own(name, system="observatory", prototype=True, log="aa")
    made = ThreadEnd(store, modem(), schema_of(observatory()[0]), CLOCK, origin=origin)
    yield made, KnowledgeWriter(store, origin, CLOCK, on_written=made.appended), store
    await store.aclose()


def test_DigitalThreadProcess_is_of_one_twin_or_the_other() -> None:
    with pytest.raises(Bug):
        DigitalThreadProcess("neither", CLOCK)
    for kind, side in ((PTDigitalThreadProcess, "physical"), (DTDigitalThreadProcess, "digital")):
        assert issubclass(kind, DigitalThreadProcess)
        assert kind.side == side
        assert not kind("new", CLOCK).knowledge, "empty after Init"


@given(payloads=st.lists(st.binary(max_size=64), max_size=20))
def test_DigitalThreadProcess_holds_shareable_DATA_in_order_with_its_duplicates(payloads: list[bytes]) -> None:
    """Ruling 2: ordered, time-stamped, duplicates kept."""
    process = PTDigitalThreadProcess("logic", CLOCK)
    for payload in payloads:
        process.respond("relay", RESPONSE(payload))
    assert [event.value for event in process.knowledge] == payloads
    assert [event.value for event in process.collect()] == payloads
    assert process.collect() == []


def test_DigitalThreadProcess_is_bounded_and_counts_what_it_drops() -> None:
    process = PTDigitalThreadProcess("logic", CLOCK, capacity=3)
    for n in range(5):
        process.respond("relay", RESPONSE(bytes([n])))
    assert ([e.value for e in process.collect()], process.dropped) == ([b"\2", b"\3", b"\4"], 2)


def test_PTDigitalThreadProcess_shares_measurements_and_statuses_with_their_quality() -> None:
    process = PTDigitalThreadProcess("gateway", CLOCK)
    process.put("ctd.pressure", TagValue(10.5, Quality.GOOD, t_ns=1))
    process.put("ctd.pressure", TagValue(10.5, Quality.BAD, Reason.TIMEOUT, t_ns=1))
    process.respond("relay", encode_status("OFF", -1))
    value, bad, status = process.collect()
    assert (value.kind, value.name, value.value, value.quality) == (Kind.VALUE, "ctd.pressure", 10.5, 0)
    assert (bad.quality, bad.reason) == (Quality.BAD, Reason.TIMEOUT), "ruling 11: never a stale good value"
    assert status.kind == Kind.STATE
    assert isinstance(status.value, bytes)
    assert decode_status(status.value) == ("OFF", -1), "ruling 7: both"


def test_DTDigitalThreadProcess_decides_which_command_is_sent() -> None:
    process = Operator("operator", CLOCK)
    process.command_period(5)
    (event,) = process.collect()
    assert event.kind == Kind.COMMAND
    assert event.value == encode_period(5).data
    assert issubclass(COMMAND, DATA)
    assert isinstance(process, DTDigitalThreadProcess)
    for kind in (PTDigitalThreadProcess, DTDigitalThreadProcess):
        assert not hasattr(kind, "command"), "the others command nobody"


@pytest.mark.parametrize(
    ("connection", "its", "others"),
    [
        (PTtoDTConnection, PTDigitalThreadProcess, DTDigitalThreadProcess),
        (DTtoPTConnection, DTDigitalThreadProcess, PTDigitalThreadProcess),
    ],
)
def test_PTtoDTConnection_and_DTtoPTConnection_have_a_transmitter_and_collect_from_their_own_twins_processes(
    tmp_path: Path,
    connection: type[PTtoDTConnection] | type[DTtoPTConnection],
    its: type[PTDigitalThreadProcess],
    others: type[DTDigitalThreadProcess],
) -> None:
    async def main() -> None:
        async with end(tmp_path, "side") as (made, writer, store):
            one, two = its("one", CLOCK), its("two", CLOCK)
            held = connection(made, [one, two], writer, CLOCK)
            one.share(Kind.VALUE, "x", 1)
            two.share(Kind.VALUE, "y", 2)
            assert held.pump() == 2
            await writer.flush()
            assert [e.name for e in await store.read(writer.origin, 1, 9)] == ["x", "y"], "the database is one of them"
            with pytest.raises(Bug):
                connection(made, [others("three", CLOCK)], writer, CLOCK)

    run(main())


def test_PTtoDTConnection_reuses_the_physical_twins_own_transmitter_driver() -> None:
    """Prose, row 5: the driver of a run serves the connection between two transmitters."""
    assert "TransmitterDriver(" in inspect.getsource(ModemCarrier.open)
    assert inspect.getmodule(ModemCarrier).TransmitterDriver is TransmitterDriver  # type: ignore[union-attr]


def test_DigitalThread_is_one_connection_each_way(tmp_path: Path) -> None:
    async def main() -> None:
        async with end(tmp_path, "plant") as (near, one, _), end(tmp_path, "shore") as (far, two, _):
            there, back = PTtoDTConnection(near, [], one, CLOCK), DTtoPTConnection(far, [], two, CLOCK)
            thread = DigitalThread(there, back)
            assert (thread.pt_data, thread.dt_data) == (there, back)
            for wrong in ((back, there), (there, there), (back, back)):
                with pytest.raises(Bug, match="one connection each way"):
                    DigitalThread(*wrong)  # type: ignore[arg-type]

    run(main())
