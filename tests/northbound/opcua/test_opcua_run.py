"""The OPC UA server of a real run, read by asyncua's client: values, status codes, times, faults, and the loss of its process."""

from __future__ import annotations

import asyncio
import os
import signal
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from asyncua import Client, Node, ua
from procs import Asking, Fieldtwin, no_tracebacks, wait_for
from received_samples import Received, check, history
from served_hall import client, running
from support import eventually

from fieldtwin.emulators.faults.registry import FAULTS
from fieldtwin.gateway.wallclock import WallClock

soon = partial(eventually, within_s=30.0)
pytestmark = [pytest.mark.long, pytest.mark.timeout(180)]


@pytest.fixture(scope="module")
def hall(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Fieldtwin, str]]:
    folder = tmp_path_factory.mktemp("h")
    with running(folder) as run:
        yield run
    no_tracebacks(folder)


async def value_of(connected: Client, name: str) -> ua.DataValue:
    return await connected.get_node(f"ns=2;s={name}").read_data_value(raise_on_bad_status=False)


def test_values_have_the_types_units_and_names_of_the_profile(hall: tuple[Fieldtwin, str]) -> None:
    async def look(url: str) -> None:
        async with client(url) as connected:
            assert (await connected.get_namespace_array())[2] == "urn:fieldtwin:hall"
            kinds = {"temperature": "Float", "flow": "Double", "ticks": "UInt32", "state": "UInt16", "serial": "String"}
            for tag, kind in kinds.items():
                value = await value_of(connected, f"sensor.{tag}")
                assert value.StatusCode.is_good(), f"{tag}: {value.StatusCode.name}"
                assert value.Value.VariantType is ua.VariantType[kind]
            assert (await value_of(connected, "sensor.serial")).Value.Value == "SN-0042"
            assert (await value_of(connected, "sensor.flow")).Value.Value == 12.5
            assert (await value_of(connected, "fan.mode")).Value.Value == 2
            node = connected.get_node("ns=2;s=sensor.temperature")
            assert await node.read_type_definition() == ua.NodeId(ua.ObjectIds.AnalogUnitRangeType)
            unit = await (await node.get_child("0:EngineeringUnits")).read_value()
            assert (unit.DisplayName.Text, unit.UnitId) == ("degC", 4_408_652)
            span = await (await node.get_child("0:EURange")).read_value()
            assert (span.Low, span.High) == (-20.0, 60.0)
            words = connected.get_node("ns=2;s=sensor.state")
            assert (await (await words.get_child("0:ValueAsText")).read_value()).Text == "FAULT"
            named = await (await words.get_child("0:EnumValues")).read_value()
            assert [(each.Value, each.DisplayName.Text) for each in named] == [(0, "OFF"), (1, "RUNNING"), (7, "FAULT")]

    asyncio.run(look(hall[1]))


def test_a_poll_with_an_equal_value_brings_a_new_time(hall: tuple[Fieldtwin, str]) -> None:
    async def look(url: str) -> None:
        async with client(url) as connected:
            before = await value_of(connected, "sensor.flow")
            async with asyncio.timeout(20):
                while (after := await value_of(connected, "sensor.flow")).SourceTimestamp == before.SourceTimestamp:
                    await asyncio.sleep(0.05)
            assert after.SourceTimestamp > before.SourceTimestamp
            assert (after.Value, after.StatusCode) == (before.Value, before.StatusCode)

    asyncio.run(look(hall[1]))


def test_a_secret_tag_has_no_variable(hall: tuple[Fieldtwin, str]) -> None:
    async def look(url: str) -> None:
        async with client(url) as connected:
            value = await value_of(connected, "sensor.code")
            assert value.StatusCode.name == "BadNodeIdUnknown"

    asyncio.run(look(hall[1]))


def test_devices_and_the_plc_are_objects_of_the_standard_models(hall: tuple[Fieldtwin, str]) -> None:
    async def names(node: Node, references: int = ua.ObjectIds.HierarchicalReferences) -> list[str]:
        return [(await each.read_browse_name()).Name for each in await node.get_referenced_nodes(references)]

    async def look(url: str) -> None:
        async with client(url) as connected:
            di = await connected.get_namespace_index("http://opcfoundation.org/UA/DI/")
            plc = await connected.get_namespace_index("http://PLCopen.org/OpcUa/IEC61131-3/")
            devices = connected.get_node(ua.NodeId(5001, di))
            assert await names(devices) == ["Objects", "sensor", "fan", "PLC"]
            sensor = await devices.get_child("2:sensor")
            kind = connected.get_node(await sensor.read_type_definition())
            assert (await kind.get_parent()).nodeid == ua.NodeId(1002, di)
            for name, text in {"Manufacturer": "Acme Works", "Model": "T-1000"}.items():
                assert (await (await sensor.get_child(f"{di}:{name}")).read_value()).Text == text
            assert await (await sensor.get_child(f"{di}:SerialNumber")).read_value() == "SN-0042"
            assert await (await sensor.get_child([f"{di}:ParameterSet", "2:ticks"])).read_value() > 0
            resource = await devices.get_child(["2:PLC", f"{plc}:Resources", "2:Resource"])
            program = await resource.get_child([f"{plc}:Programs", "2:control"])
            assert await program.read_type_definition() == ua.NodeId(1004, plc)
            assert await names(program, ua.NodeId(4001, plc)) == ["temperature"]
            assert await names(program, ua.NodeId(4002, plc)) == ["mode"]
            assert await names(program, ua.NodeId(4004, plc)) == ["runs"]
            assert await names(program, ua.NodeId(4006, plc)) == ["main"]
            task = await resource.get_child([f"{plc}:Tasks", "2:main", f"{plc}:Interval"])
            assert await task.read_value() == "T#20ms"
            assert (await value_of(connected, "control.mode")).Value.Value == 2
            assert (await value_of(connected, "control.runs")).Value.Value is True

    asyncio.run(look(hall[1]))


def test_clients_can_change_nothing(hall: tuple[Fieldtwin, str]) -> None:
    async def tries(url: str) -> None:
        async with client(url) as connected:
            for name in ("fan.mode", "fan.lamp", "sensor.temperature", "control.mode", "sensor.temperature/EURange"):
                node = connected.get_node(f"ns=2;s={name}")
                before = await node.read_data_value()
                with pytest.raises(ua.UaStatusCodeError, match=r"BadNotWritable|BadUserAccessDenied"):
                    await node.write_value(before.Value)
            with pytest.raises(ua.UaStatusCodeError, match="BadUserAccessDenied"):
                await connected.nodes.objects.add_object(2, "new")
            with pytest.raises(ua.UaStatusCodeError, match="BadUserAccessDenied"):
                await connected.get_node("ns=2;s=sensor").delete()
            assert (await value_of(connected, "sensor.ticks")).StatusCode.is_good()

    asyncio.run(tries(hall[1]))


def test_every_sample_equals_the_gateways_record_under_each_fault(hall: tuple[Fieldtwin, str]) -> None:
    run, url = hall
    gateway, field = run.control("hall", "gateway"), run.control("hall", "field")
    received = Received()

    async def follow() -> None:
        async with client(url) as connected:
            subscription = await connected.create_subscription(50, received)
            tags = [connected.get_node(f"ns=2;s=sensor.{tag}") for tag in ("temperature", "ticks", "flow")]
            await subscription.subscribe_data_change(tags)
            await soon(lambda: received.latest("sensor.flow") == "Good")
            for name in FAULTS:
                if name not in LIVE:
                    continue
                await asyncio.to_thread(field, "fault", fault={"id": "f", "name": name, "device": "sensor"})
                await asyncio.sleep(0.6)
                await asyncio.to_thread(field, "clear", id="f")
                await soon(lambda: received.latest("sensor.flow") == "Good")
            await asyncio.to_thread(field, "fault", fault={"id": "f", "name": "silence", "device": "sensor"})
            await soon(lambda: received.latest("sensor.temperature") == "BadNoCommunication")
            await asyncio.to_thread(field, "clear", id="f")
            await soon(lambda: received.latest("sensor.temperature") == "Good")
            await asyncio.to_thread(field, "fault", fault={"id": "f", "name": "exception", "device": "sensor"})
            await soon(lambda: received.latest("sensor.temperature") == "BadDeviceFailure")
            await asyncio.to_thread(field, "clear", id="f")
            await soon(lambda: received.latest("sensor.temperature") == "Good")

    asyncio.run(follow())
    clock = WallClock()
    offset_ns = clock.utc_ns() - clock.monotonic_ns()
    good, changes = history(gateway)
    statuses = {data.StatusCode.name for _, data, _ in received.samples}
    assert {"Good", "BadNoCommunication", "BadDeviceFailure"} <= statuses
    for sample in received.samples[3:]:  # the first samples may be older than the gateway's journal
        check(sample, offset_ns, good, changes)


LIVE = (
    "drop", "corrupt-length", "wrong-unit", "wrong-function", "wrong-transaction", "fewer-registers", "truncate", "garbage",
    "late-reply", "busy", "reset",
)  # fmt: skip
"""Faults that act on a TCP connection and leave a trace in the quality of tags."""


def test_the_status_of_the_gateway_shows_server_and_clients(hall: tuple[Fieldtwin, str]) -> None:
    run, url = hall

    async def connected_twice() -> dict[str, Any]:
        async with client(url), client(url):
            async with asyncio.timeout(20):
                while True:
                    status = await asyncio.to_thread(run.control("hall", "gateway"), "get", brief=True)
                    if len(status["serve"]["scada"]["clients"]) == 2:
                        return dict(status["serve"]["scada"])
                    await asyncio.sleep(0.1)

    status = asyncio.run(connected_twice())
    assert (status["kind"], status["listening"], status["error"]) == ("opcua", url, "")
    assert status["counters"]["updates"] > 10


def test_a_dead_server_process_is_reported_and_restarted_and_the_gateway_polls_on(tmp_path: Path) -> None:
    with running(tmp_path) as (run, url):
        gateway = run.control("hall", "gateway")
        killed = server_pid(run)
        polls = gateway("get", brief=True)["devices"]["sensor"]["polls"]
        os.kill(killed, signal.SIGKILL)
        pid = wait_for(lambda: (found := server_pid(run)) not in (0, killed) and found, 20, "a new process")
        assert pid != killed
        assert gateway("get", brief=True)["devices"]["sensor"]["polls"] >= polls
        again = wait_for(lambda: is_new(gateway, url), 60, "the new server")

        async def look() -> None:
            async with client(again) as connected:
                assert (await value_of(connected, "sensor.serial")).Value.Value == "SN-0042"

        asyncio.run(look())
        run.signal(signal.SIGINT)
        run.wait()
        assert "opcua-scada: ended with signal 9" in run.err + run.out


def is_new(gateway: Asking, before: str) -> str:
    listening = gateway("get", brief=True)["serve"]["scada"]["listening"]
    return listening if listening and listening != before else ""


def server_pid(run: Fieldtwin) -> int:
    """The process ID of the OPC UA server of this run, or 0."""
    for entry in Path("/proc").iterdir():
        try:
            words = (entry / "cmdline").read_bytes().split(b"\0") if entry.name.isdigit() else []
        except OSError:
            continue
        if b"fieldtwin.northbound.opcua.process" in words and str(run.root).encode() in b"".join(words):
            return int(entry.name)
    return 0
