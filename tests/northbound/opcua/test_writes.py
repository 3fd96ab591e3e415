"""Writes of OPC UA clients in a real run: who may write what, the status codes, the audit log, and when the value appears."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from asyncua import Client, ua
from procs import Fieldtwin, no_tracebacks
from received_samples import Received, check, history
from secured_server import client_of
from served_hall import running
from support import eventually

from fieldtwin.gateway.wallclock import WallClock

soon = partial(eventually, within_s=30.0)
pytestmark = [pytest.mark.long, pytest.mark.timeout(240)]
Run = tuple[Fieldtwin, str]
BOOLEAN, DOUBLE, UINT16 = ua.VariantType.Boolean, ua.VariantType.Double, ua.VariantType.UInt16


@pytest.fixture(scope="module")
def hall(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Run]:
    folder = tmp_path_factory.mktemp("w")
    with running(folder, secured=True) as run:
        yield run
    no_tracebacks(folder)


@asynccontextmanager
async def session(run: Run, user: str = "anna") -> AsyncIterator[Client]:
    async with await client_of(run[1], run[0].root / "hmi.der", user=user) as connected:
        await soon(lambda: may_be_written(connected, "fan.lamp"))
        yield connected


async def may_be_written(connected: Client, name: str) -> bool:
    return ua.AccessLevel.CurrentWrite in await connected.get_node(f"ns=2;s={name}").get_access_level()


async def write(connected: Client, node: str, value: ua.DataValue, attribute: Any = ua.AttributeIds.Value) -> str:
    """Write, and return the name of the status code of the result."""
    item = ua.WriteValue(ua.NodeId.from_string(node), attribute, None, value)
    [code] = await connected.uaclient.session.write(ua.WriteParameters([item]))
    return str(code.name)


async def is_written(connected: Client, node: str, value: ua.DataValue) -> bool:
    """Write, and return whether the device has the value. The gateway writes a tag at most ten times a second."""
    code = await write(connected, node, value)
    assert code in ("Good", "BadInvalidState")
    return code == "Good"


def value_of(value: Any, kind: ua.VariantType) -> ua.DataValue:
    return ua.DataValue(ua.Variant(value, kind))


def audited(run: Run) -> list[dict[str, Any]]:
    path = run[0].root / "hall/audit.jsonl"
    entries = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    return [entry for entry in entries if str(entry["by"]).startswith("opcua ")]


def test_a_write_reaches_the_device_and_the_audit_log_names_user_and_address(hall: Run) -> None:
    async def writes() -> None:
        async with session(hall) as connected:
            assert await write(connected, "ns=2;s=fan.lamp", value_of(True, BOOLEAN)) == "Good"
            await soon(lambda: is_value(connected, "fan.lamp", True))
            assert await write(connected, "ns=2;s=fan.limit", value_of(12.5, DOUBLE)) == "Good"
            await soon(lambda: is_value(connected, "fan.limit", 12.5))

    asyncio.run(writes())
    entries = [(e["action"], e["tag"], e["new"], e["result"]) for e in audited(hall) if e["action"] == "write"]
    assert entries[-4:] == [
        ("write", "fan.lamp", 1.0, "asked"), ("write", "fan.lamp", 1.0, "done"),
        ("write", "fan.limit", 12.5, "asked"), ("write", "fan.limit", 12.5, "done"),
    ]  # fmt: skip
    assert {e["by"] for e in audited(hall) if e["action"] == "write"} == {"opcua scada anna 127.0.0.1"}


async def is_value(connected: Client, name: str, value: Any) -> bool:
    found = await connected.get_node(f"ns=2;s={name}").read_data_value(raise_on_bad_status=False)
    return bool(found.Value.Value == value)


def test_a_written_value_is_not_good_before_the_image_has_it(hall: Run) -> None:
    received = Received()

    async def writes() -> None:
        async with session(hall) as connected:
            subscription = await connected.create_subscription(50, received)
            await subscription.subscribe_data_change([connected.get_node("ns=2;s=fan.limit")])
            for value in (20.0, 30.0, 40.0):
                await soon(lambda: received.latest("fan.limit") == "Good")
                await soon(lambda value=value: is_written(connected, "ns=2;s=fan.limit", value_of(value, DOUBLE)))
                await soon(lambda value=value: received.samples[-1][1].Value.Value == value)

    asyncio.run(writes())
    clock = WallClock()
    good, changes = history(hall[0].control("hall", "gateway"))
    assert [data.Value.Value for _, data, _ in received.samples][-3:] == [20.0, 30.0, 40.0]
    for sample in received.samples[1:]:
        check(sample, clock.utc_ns() - clock.monotonic_ns(), good, changes)


def test_access_levels_are_those_of_the_plant_and_of_the_user(hall: Run) -> None:
    async def levels(user: str) -> dict[str, tuple[bool, bool]]:
        found = {}
        async with session(hall, user) as connected:
            for name in ("fan.lamp", "fan.limit", "fan.mode", "sensor.temperature", "control.runs"):
                node = connected.get_node(f"ns=2;s={name}")
                own = ua.AccessLevel.CurrentWrite in await node.get_user_access_level()
                found[name] = await may_be_written(connected, name), own
        return found

    never = dict.fromkeys(("fan.mode", "sensor.temperature", "control.runs"), (False, False))
    assert asyncio.run(levels("anna")) == {"fan.lamp": (True, True), "fan.limit": (True, True)} | never
    assert asyncio.run(levels("bert")) == {"fan.lamp": (True, False), "fan.limit": (True, False)} | never


BAD = ua.StatusCode(ua.StatusCodes.Bad)
GOOD_TRUE = value_of(True, BOOLEAN)
REFUSALS = [
    ("bert", "ns=2;s=fan.lamp", GOOD_TRUE, "BadUserAccessDenied", "the role view may not write"),
    ("anna", "ns=2;s=fan.mode", value_of(1, UINT16), "BadNotWritable", "cannot be commanded by this client"),
    ("anna", "ns=2;s=sensor.state", value_of(1, UINT16), "BadNotWritable", "cannot be commanded by this client"),
    ("anna", "ns=2;s=sensor.temperature/EURange", GOOD_TRUE, "BadNotWritable", "only values of tags"),
    ("anna", "ns=2;s=control.runs", GOOD_TRUE, "BadNotWritable", "only values of tags"),
    ("anna", "ns=2;s=sensor.serial", value_of("x", ua.VariantType.String), "BadNotWritable", "only values of tags"),
    ("anna", "i=2258", GOOD_TRUE, "BadNotWritable", "only values of tags"),
    ("anna", "ns=2;s=fan.limit", value_of(100.5, DOUBLE), "BadOutOfRange", "outside its limits"),
    ("anna", "ns=2;s=fan.limit", value_of(float("nan"), DOUBLE), "BadOutOfRange", "not finite"),
    ("anna", "ns=2;s=fan.limit", value_of(5, UINT16), "BadTypeMismatch", "the type is UInt16, not Double"),
    ("anna", "ns=2;s=fan.limit", value_of([1.0, 2.0], DOUBLE), "BadTypeMismatch", "the type is Double[], not Double"),
    ("anna", "ns=2;s=fan.limit", ua.DataValue(), "BadTypeMismatch", "the type is"),
    ("anna", "ns=2;s=fan.lamp", ua.DataValue(ua.Variant(True), BAD), "BadWriteNotSupported", "status Good"),
]  # fmt: skip


@pytest.mark.parametrize(("user", "node", "value", "code", "reason"), REFUSALS)
def test_a_refused_write_has_a_specific_code_and_an_entry_in_the_audit_log(
    hall: Run, user: str, node: str, value: ua.DataValue, code: str, reason: str
) -> None:
    tag, before = node.removeprefix("ns=2;s="), len(audited(hall))

    async def is_audited(connected: Client) -> bool:
        """Write, and return whether the log has the refusal. It has one entry a second for each tag, cause and client."""
        assert await write(connected, node, value) == code
        entries = [e for e in audited(hall)[before:] if e["tag"] == tag]
        assert all((e["action"], e["by"]) == ("refuse", f"opcua scada {user} 127.0.0.1") for e in entries)
        return any(reason.lower() in e["result"].lower() for e in entries)

    async def writes() -> None:
        async with session(hall, user) as connected:
            await soon(lambda: is_audited(connected))

    asyncio.run(writes())


def test_nodes_that_do_not_exist_and_other_attributes_cannot_be_written(hall: Run) -> None:
    async def writes() -> None:
        async with session(hall) as connected:
            assert await write(connected, "ns=2;s=sensor.code", value_of(1, UINT16)) == "BadNodeIdUnknown"
            name = ua.DataValue(ua.Variant(ua.LocalizedText("x"), ua.VariantType.LocalizedText))
            assert await write(connected, "ns=2;s=fan.lamp", name, ua.AttributeIds.DisplayName) == "BadNotWritable"

    asyncio.run(writes())


def test_a_silent_device_gives_a_bad_code_and_does_not_delay_other_requests(hall: Run) -> None:
    field = hall[0].control("hall", "field")

    async def writes() -> None:
        async with session(hall) as connected:
            await asyncio.to_thread(field, "fault", fault={"id": "f", "name": "silence", "device": "fan"})
            try:
                writing = asyncio.create_task(write(connected, "ns=2;s=fan.lamp", value_of(False, BOOLEAN)))
                assert (await connected.get_node("ns=2;s=sensor.flow").read_value()) == 12.5
                assert await writing in ("BadTimeout", "BadNoCommunication")
                await soon(lambda: is_refused(connected))
            finally:
                await asyncio.to_thread(field, "clear", id="f")

    async def is_refused(connected: Client) -> bool:
        return await write(connected, "ns=2;s=fan.lamp", value_of(False, BOOLEAN)) == "BadNoCommunication"

    asyncio.run(writes())


def test_a_request_with_too_many_values_is_refused_as_a_whole(hall: Run) -> None:
    async def writes() -> None:
        async with session(hall) as connected:
            item = ua.WriteValue(ua.NodeId.from_string("ns=2;s=fan.lamp"), ua.AttributeIds.Value, None, GOOD_TRUE)
            with pytest.raises(ua.UaStatusCodeError, match="BadTooManyOperations"):
                await connected.uaclient.session.write(ua.WriteParameters([item] * 101))

    asyncio.run(writes())


def test_the_status_counts_writes_and_refusals(hall: Run) -> None:
    counters = hall[0].control("hall", "gateway")("get", brief=True)["serve"]["scada"]["counters"]
    assert counters.keys() == {"updates", "writes", "refused"}


def test_the_folder_has_no_password(hall: Run) -> None:
    for path in Path(hall[0].root, "hall").glob("*.log"):
        assert "correct horse" not in path.read_text(encoding="utf-8", errors="replace")
