"""Threads over a real mosquitto: loss, deaths of either side and of the broker, refusals, and the view of a third-party host."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path

import pytest
from local_mosquitto import Mosquitto, broker
from support import eventually, run
from thread_rig import SCHEMA, ShakyCarrier, Twin, equal, value

from fieldtwin.gateway.core.errors import Unreachable
from fieldtwin.gateway.store.event import Event, Kind
from fieldtwin.gateway.wallclock import WallClock
from fieldtwin.twin.thread.link import Carrier, Unwelcome
from fieldtwin.twin.thread.mqtt.session import Broker
from fieldtwin.twin.thread.mqtt_carrier import MqttCarrier
from fieldtwin.twin.thread.sparkplug import EdgeNode, HostApplication
from fieldtwin.twin.thread.sparkplug_payloads import decode_payload

pytestmark = pytest.mark.interop
CLOCK = WallClock()


def edge(here: Mosquitto, **who: str) -> MqttCarrier:
    return MqttCarrier(
        Broker("127.0.0.1", here.port, **who),
        lambda n, ms: EdgeNode("plants", "test", "shore", SCHEMA, {}, n, ms),
        CLOCK,
    )


def host(here: Mosquitto) -> MqttCarrier:
    return MqttCarrier(
        Broker("127.0.0.1", here.port), lambda n, ms: HostApplication("plants", "test", "shore", ms), CLOCK
    )


def test_over_a_broker_with_loss_deaths_and_a_broker_that_restarts_both_logs_are_equal(tmp_path: Path) -> None:
    async def main() -> None:
        with broker(tmp_path) as here:
            seeds = iter(range(100))

            def shaken(carrier: Carrier) -> Carrier:
                return ShakyCarrier(carrier, next(seeds))

            plant = Twin("plant", tmp_path, CLOCK, lambda: shaken(edge(here)))
            shore = Twin("shore", tmp_path, CLOCK, lambda: shaken(host(here)))
            await shore.start()
            await plant.start()
            for n in range(30):
                await plant.log(*(value(20 * n + i) for i in range(20)))
                await asyncio.sleep(0.01)
                if n == 10:
                    await shore.log(Event(0, 1, Kind.COMMAND, "shore", b"\0\1"))
                    await shore.kill()
                    await shore.start()
                if n == 20:
                    await plant.kill()
                    await plant.start()
            here.stop()
            await eventually(lambda: not plant.end.connected and not shore.end.connected)
            await plant.log(value(600))
            here.start()
            await eventually(lambda: equal(plant, shore), within_s=20)
            assert [e.value for e in plant.arrived if e.kind == Kind.COMMAND] == [b"\0\1"]
            assert len(await shore.all_of(plant.origin)) == 601
            await plant.kill()
            await shore.kill()

    run(main(), timeout_s=40)


def test_a_broker_that_refuses_or_is_missing_is_reported(tmp_path: Path) -> None:
    async def main() -> None:
        (tmp_path / "nobody").write_text("")
        with broker(tmp_path, "allow_anonymous false", f"password_file {tmp_path / 'nobody'}") as here:
            with pytest.raises(Unwelcome, match="the broker refuses the connection: Not authorized") as caught:
                await edge(here, username="plant", password="wrong").open()
            assert caught.value.exit_code == 4
            assert "wrong" not in str(caught.value)
            plant = Twin("plant", tmp_path, CLOCK, lambda: edge(here))
            await plant.start()
            await plant.log(value(1))
            await eventually(lambda: "the broker refuses" in plant.end.trouble)
            assert plant.end.waiting == 1
            await plant.kill()
        with pytest.raises(Unreachable, match="the broker cannot be reached"):
            await edge(here).open()

    run(main())


def test_a_third_party_host_sees_births_data_and_deaths(tmp_path: Path) -> None:
    """The traffic on the broker, for a client that knows Sparkplug but no thread."""
    import aiomqtt

    async def main() -> None:
        with broker(tmp_path) as here:
            seen: list[tuple[str, bytes]] = []

            async def watch(client: aiomqtt.Client) -> None:
                async for message in client.messages:
                    assert isinstance(message.payload, bytes)
                    seen.append((message.topic.value, message.payload))

            async with aiomqtt.Client("127.0.0.1", here.port) as client:
                await client.subscribe("spBv1.0/#")
                watching = asyncio.create_task(watch(client))
                plant = Twin("plant", tmp_path, CLOCK, lambda: edge(here))
                shore = Twin("shore", tmp_path, CLOCK, lambda: host(here))
                await plant.start()
                await shore.start()
                await plant.log(value(1), value(2))
                await eventually(lambda: equal(plant, shore))
                await plant.kill()
                await shore.kill()
                last = {"spBv1.0/plants/NDEATH/test": 1, "spBv1.0/STATE/shore": 2}
                await eventually(lambda: all(sum(t == topic for t, _ in seen) == n for topic, n in last.items()))
                watching.cancel()
                await asyncio.gather(watching, return_exceptions=True)
            kinds = [topic.split("/")[2] for topic, _ in seen if topic.startswith("spBv1.0/plants/")]
            assert kinds.index("NBIRTH") < kinds.index("NDATA") < kinds.index("NDEATH")
            data = [decode_payload(p) for t, p in seen if "NDATA" in t]
            values = [m.value for payload in data for m in payload.metrics if m.alias in (1, 2)]
            assert values[:2] == [value(1).value, value(2).value]
            assert all(m.historical for payload in data for m in payload.metrics if m.alias in (1, 2))
            birth, death = (json.loads(payload) for topic, payload in seen if topic == "spBv1.0/STATE/shore")
            assert (birth["online"], death["online"]) == (True, False)
            assert birth["timestamp"] == death["timestamp"] == pytest.approx(CLOCK.utc_ns() / 1e6, abs=60_000)

    run(main())
