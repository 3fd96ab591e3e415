"""Alarms & Conditions (OPC 10000-9) of a real run, with asyncua's client: events, refresh, variables, and acknowledgement."""

from __future__ import annotations

import asyncio
import json
import os
import signal
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager
from functools import partial
from typing import Any

import pytest
from asyncua import Client, ua
from procs import Fieldtwin, no_tracebacks
from secured_server import client_of
from served_hall import running
from support import eventually

soon = partial(eventually, within_s=30.0)
pytestmark = [pytest.mark.long, pytest.mark.timeout(240)]
Run = tuple[Fieldtwin, str]
ALARMS = """alarms:
  limit_high: {condition: "fan.limit > 50", priority: high, text: "The limit is high", on_delay_ms: 100}
  hot: {condition: "sensor.temperature > 1000"}
"""
ACKNOWLEDGE = ua.NodeId(ua.ObjectIds.AcknowledgeableConditionType_Acknowledge)
REFRESH = ua.NodeId(ua.ObjectIds.ConditionType_ConditionRefresh)
CONDITION_TYPE = ua.NodeId(ua.ObjectIds.ConditionType)
LIMIT_HIGH = ua.NodeId("alarm.limit_high", 2)


@pytest.fixture(scope="module")
def hall(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Run]:
    folder = tmp_path_factory.mktemp("a")
    with running(folder, secured=True, more=ALARMS) as run:
        yield run
    no_tracebacks(folder)


class Received:
    """The events that a client has received."""

    def __init__(self) -> None:
        self.events: list[Any] = []

    def event_notification(self, event: Any) -> None:
        self.events.append(event)

    def of(self, name: str) -> list[Any]:
        return [e for e in self.events if getattr(e, "ConditionName", None) == name]


@asynccontextmanager
async def session(run: Run, user: str = "anna") -> AsyncIterator[Client]:
    async with await client_of(run[1], run[0].root / "hmi.der", user=user) as connected:
        await soon(lambda: is_good(connected, "limit_high"))
        yield connected


async def field(connected: Client, path: str) -> Any:
    return await connected.get_node(f"ns=2;s=alarm.{path}").read_value()


async def is_good(connected: Client, name: str) -> bool:
    quality = await field(connected, f"{name}/Quality")
    return bool(quality is not None and quality.is_good())


async def set_limit(connected: Client, value: float) -> None:
    async def written() -> bool:
        data = ua.DataValue(ua.Variant(value, ua.VariantType.Double))
        item = ua.WriteValue(ua.NodeId("fan.limit", 2), ua.AttributeIds.Value, None, data)
        [code] = await connected.uaclient.session.write(ua.WriteParameters([item]))
        return code.name == "Good"

    await soon(written)


async def follow(connected: Client) -> tuple[Any, Received]:
    received = Received()
    subscription = await connected.create_subscription(50, received)
    await subscription.subscribe_alarms_and_conditions(ua.ObjectIds.Server, ua.ObjectIds.AlarmConditionType)
    return subscription, received


async def call(connected: Client, method: ua.NodeId, node: ua.NodeId, *arguments: ua.Variant) -> str:
    """Call a method, and return the name of the status code."""
    request = ua.CallMethodRequest(ObjectId=node, MethodId=method, InputArguments=list(arguments))
    [result] = await connected.uaclient.session.call([request])
    return str(result.StatusCode.name)


def acknowledgement(event_id: bytes, comment: str) -> tuple[ua.Variant, ua.Variant]:
    text = ua.Variant(ua.LocalizedText(comment), ua.VariantType.LocalizedText)
    return ua.Variant(event_id, ua.VariantType.ByteString), text


async def latest(received: Received, name: str, active: bool, acked: bool) -> Any:
    """Wait for an event of the alarm with these states, and return it."""

    def fits() -> bool:
        found = received.of(name)
        return bool(found) and states(found[-1]) == (active, acked)

    await soon(fits)
    return received.of(name)[-1]


def states(event: Any) -> tuple[bool, bool]:
    return getattr(event, "ActiveState/Id"), getattr(event, "AckedState/Id")


def test_an_alarm_is_an_event_until_it_is_acknowledged_and_returns_to_normal(hall: Run) -> None:
    async def look() -> None:
        async with session(hall) as connected:
            _, received = await follow(connected)
            await set_limit(connected, 60.0)
            raised = await latest(received, "limit_high", active=True, acked=False)
            assert raised.EventType == ua.NodeId(ua.ObjectIds.AlarmConditionType)
            assert (raised.Severity, raised.Message.Text, raised.Retain) == (700, "The limit is high", True)
            assert raised.NodeId == LIMIT_HIGH
            assert raised.Quality.is_good()
            code = await call(connected, ACKNOWLEDGE, LIMIT_HIGH, *acknowledgement(raised.EventId, "seen"))
            assert code == "Good"
            acknowledged = await latest(received, "limit_high", active=True, acked=True)
            assert (acknowledged.Comment.Text, acknowledged.ClientUserId) == ("seen", "anna")
            await set_limit(connected, 10.0)
            normal = await latest(received, "limit_high", active=False, acked=True)
            assert normal.Retain is False
        text = (hall[0].root / "hall/audit.jsonl").read_text(encoding="utf-8")
        [entry] = [e for e in map(json.loads, text.splitlines()) if e["action"] == "acknowledge"]
        assert entry["by"].startswith("opcua scada anna ")
        assert (entry["device"], entry["comment"]) == ("alarm.limit_high", "seen")

    asyncio.run(look())


def test_the_variables_of_a_condition_have_the_values_of_its_last_event(hall: Run) -> None:
    async def look() -> None:
        async with session(hall) as connected:
            objects = connected.nodes.objects
            condition = await objects.get_child(["2:Alarms", "2:hot"])
            assert condition.nodeid == ua.NodeId("alarm.hot", 2)
            assert await condition.read_type_definition() == ua.NodeId(ua.ObjectIds.AlarmConditionType)
            assert await field(connected, "hot/ActiveState/Id") is False
            assert (await field(connected, "hot/AckedState")).Text == "Acknowledged"
            assert await field(connected, "hot/Severity") == 500
            assert await field(connected, "limit_high/OnDelay") == 100.0
            methods = [n.nodeid for n in await condition.get_methods()]
            assert methods == [ACKNOWLEDGE]

    asyncio.run(look())


def test_a_refresh_reports_the_conditions_that_matter_to_a_client_that_connects_later(hall: Run) -> None:
    async def look() -> None:
        async with session(hall) as connected:
            await set_limit(connected, 60.0)
            await soon(lambda: field(connected, "limit_high/ActiveState/Id"))
            subscription, received = await follow(connected)
            number = ua.Variant(subscription.subscription_id, ua.VariantType.UInt32)
            assert await call(connected, REFRESH, CONDITION_TYPE, number) == "Good"
            await latest(received, "limit_high", active=True, acked=False)
            assert received.of("hot") == []
            async with session(hall, "bert") as other:  # the subscription is not that of this session
                assert await call(other, REFRESH, CONDITION_TYPE, number) == "BadSubscriptionIdInvalid"
            await set_limit(connected, 10.0)
            returned = await latest(received, "limit_high", active=False, acked=False)
            assert returned.Retain is True
            await call(connected, ACKNOWLEDGE, LIMIT_HIGH, *acknowledgement(returned.EventId, ""))
            await latest(received, "limit_high", active=False, acked=True)

    asyncio.run(look())


def test_acknowledgements_that_are_refused(hall: Run) -> None:
    async def look() -> None:
        async with session(hall) as connected, session(hall, "bert") as viewer:
            assert await call(connected, ACKNOWLEDGE, LIMIT_HIGH, *acknowledgement(b"x", "")) == (
                "BadConditionBranchAlreadyAcked"
            )
            _, received = await follow(connected)
            await set_limit(connected, 60.0)
            raised = await latest(received, "limit_high", active=True, acked=False)
            given = acknowledgement(raised.EventId, "")
            assert await call(viewer, ACKNOWLEDGE, LIMIT_HIGH, *given) == "BadUserAccessDenied"
            assert await call(connected, ACKNOWLEDGE, LIMIT_HIGH, *acknowledgement(b"x", "")) == "BadEventIdUnknown"
            assert await call(connected, ACKNOWLEDGE, LIMIT_HIGH, given[0]) == "BadArgumentsMissing"
            assert await call(connected, ACKNOWLEDGE, LIMIT_HIGH, given[1], given[0]) == "BadInvalidArgument"
            assert await call(connected, ACKNOWLEDGE, ua.NodeId("fan.limit", 2), *given) == "BadNodeIdInvalid"
            disable = ua.NodeId(ua.ObjectIds.ConditionType_Disable)
            assert await call(connected, disable, LIMIT_HIGH) == "BadMethodInvalid"
            assert await field(connected, "limit_high/AckedState/Id") is False
            assert await call(connected, ACKNOWLEDGE, LIMIT_HIGH, *given) == "Good"
            await latest(received, "limit_high", active=True, acked=True)

    asyncio.run(look())


def test_a_stopped_gateway_makes_the_quality_of_every_condition_bad(hall: Run) -> None:
    gateway = hall[0].control("hall", "gateway")
    pid = gateway("ready")["pid"]

    async def look() -> None:
        async with session(hall) as connected:
            before = await field(connected, "limit_high/ActiveState/Id")
            os.kill(pid, signal.SIGSTOP)
            try:
                await soon(lambda: is_bad(connected))
                assert await field(connected, "limit_high/ActiveState/Id") is before
                assert (await field(connected, "hot/Quality")).name == "BadShutdown"
                assert await field(connected, "hot/Retain") is True
            finally:
                os.kill(pid, signal.SIGCONT)
            await soon(lambda: is_good(connected, "hot"))

    async def is_bad(connected: Client) -> bool:
        return (await field(connected, "limit_high/Quality")).is_bad()

    asyncio.run(look())
