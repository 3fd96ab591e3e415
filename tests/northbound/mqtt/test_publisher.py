"""A publisher and a real mosquitto, watched by a host application that shares no code with it."""

from __future__ import annotations

import asyncio
import json
import shutil
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import paho.mqtt.client as paho
import pytest
from cut_cable import cable
from hall_publication import GOOD, connected, edge_node, json_messages, note, note_all, published, silent
from local_mosquitto import Mosquitto, broker, program
from modbus_pki import Pki, make_pki
from sparkplug_host import Host, host, property_of, value_of
from support import eventually, run

from fieldtwin.northbound.mqtt import publisher as publisher_module
from fieldtwin.northbound.mqtt.publication import WriteRequest
from fieldtwin.twin.site.servers.broker_url import BrokerUrl
from fieldtwin.twin.site.servers.serving_mqtt import JsonConfig

pytestmark = [pytest.mark.interop, pytest.mark.long, pytest.mark.timeout(180)]
LONG_S = 90.0


@pytest.fixture
def mosquitto(tmp_path: Path) -> Iterator[Mosquitto]:
    with broker(tmp_path) as made:
        yield made


def at(mosquitto: Mosquitto) -> BrokerUrl:
    return BrokerUrl("127.0.0.1", mosquitto.port)


async def seen(watching: Host, kind: str, device: str = "", count: int = 1) -> None:
    """Wait for messages of a kind."""
    await eventually(lambda: len(watching.of(kind, device)) >= count, within_s=40, what=f"{count} {kind} {device}")


def test_a_host_sees_births_data_and_the_death_of_a_node_that_ends(mosquitto: Mosquitto, tmp_path: Path) -> None:
    async def main() -> None:
        node = edge_node()
        note_all(node, 2000)
        with host(mosquitto.port) as watching:
            async with published(node, at(mosquitto), tmp_path) as publisher:
                await connected(publisher)
                await seen(watching, "DBIRTH", "fan")
                note(node, 3000, sensor__offset=7)
                publisher.wake()
                await seen(watching, "DDATA", "sensor")
            await seen(watching, "NDEATH")
            kinds = [(m.kind, m.device) for m in watching.messages]
            assert kinds == [
                ("NBIRTH", ""), ("DBIRTH", "sensor"), ("DBIRTH", "fan"), ("DDATA", "sensor"), ("NDEATH", ""),
            ]  # fmt: skip
            assert [m.qos for m in watching.messages] == [0, 0, 0, 0, 1]
            assert not any(m.retain for m in watching.messages)
            [death] = watching.of("NDEATH")
            assert [(m.name, value_of(m)) for m in death.payload.metrics] == [("bdSeq", 0)]
            assert not death.payload.HasField("seq")
            birth = watching.of("DBIRTH", "sensor")[0].by_name
            assert property_of(birth["temperature"], "engUnit") == "degC"
            assert property_of(birth["temperature"], "engHigh") == 60.0
            assert (birth["offset"].int_value, birth["ticks"].int_value) == ((1 << 32) - 5, 4_000_000_000)

    run(main(), LONG_S)


def test_a_node_whose_connection_is_cut_dies_by_its_will(mosquitto: Mosquitto, tmp_path: Path) -> None:
    async def main() -> None:
        node = edge_node()
        note_all(node, 2000)
        with host(mosquitto.port) as watching:
            async with (
                cable(mosquitto.port) as between,
                published(node, BrokerUrl("127.0.0.1", between.port), tmp_path) as publisher,
            ):
                await connected(publisher)
                await seen(watching, "NBIRTH")
                between.cut()
                await seen(watching, "NDEATH")
                await seen(watching, "NBIRTH", count=2)
            numbers = [value_of(m.by_name["bdSeq"]) for m in watching.messages if m.kind in ("NBIRTH", "NDEATH")]
            assert numbers[:3] == [0, 0, 1]

    run(main(), LONG_S)


def test_a_rebirth_request_brings_all_births_again(mosquitto: Mosquitto, tmp_path: Path) -> None:
    async def main() -> None:
        node = edge_node()
        note_all(node, 2000)
        with host(mosquitto.port) as watching:
            async with published(node, at(mosquitto), tmp_path) as publisher:
                await connected(publisher)
                await seen(watching, "DBIRTH", "fan")
                await asyncio.to_thread(watching.command, Node_Control__Rebirth=True)
                await seen(watching, "DBIRTH", "fan", count=2)
                first, second = watching.of("NBIRTH")
                assert value_of(first.by_name["bdSeq"]) == value_of(second.by_name["bdSeq"])
                assert (first.payload.seq, second.payload.seq) == (0, 0)

    run(main(), LONG_S)


def test_a_silent_device_dies_and_is_born_again(mosquitto: Mosquitto, tmp_path: Path) -> None:
    async def main() -> None:
        node = edge_node()
        note_all(node, 2000)
        with host(mosquitto.port) as watching:
            async with published(node, at(mosquitto), tmp_path) as publisher:
                await connected(publisher)
                silent(node, "fan", 3000)
                publisher.wake()
                await seen(watching, "DDEATH", "fan")
                note_all(node, 4000)
                publisher.wake()
                await seen(watching, "DBIRTH", "fan", count=2)
                await seen(watching, "DDATA", "fan")
                late = watching.of("DDATA", "fan")[0].payload.metrics
                assert [(value_of(m), m.timestamp, m.is_historical) for m in late] == [(None, 3000, True)] * 2

    run(main(), LONG_S)


def test_a_restart_of_the_broker_loses_no_sample_and_repeats_none(mosquitto: Mosquitto, tmp_path: Path) -> None:
    async def main() -> None:
        node = edge_node()
        note_all(node, 2000)
        written: list[tuple[int, int]] = []

        async def count(publisher: publisher_module.Publisher, until: int) -> None:
            for value in range(len(written), until):
                written.append((value, 10_000 + value))
                note(node, written[-1][1], control__total=value + 1000)
                publisher.wake()
                await asyncio.sleep(0)

        with host(mosquitto.port) as watching:
            async with published(node, at(mosquitto), tmp_path) as publisher:
                await connected(publisher)
                await count(publisher, 100)
                mosquitto.stop()
                await eventually(lambda: not publisher.is_connected, within_s=40)
                await count(publisher, 400)
                mosquitto.start()
                await seen(watching, "NBIRTH", count=2)
                await count(publisher, 450)
                await connected(publisher)
                await eventually(lambda: any(m.timestamp == written[-1][1] for m in total(watching)), within_s=40)
            found = [(value_of(m) - 1000, m.timestamp) for m in total(watching) if value_of(m) >= 1000]
            assert sorted(set(found)) == written
            assert node.backlog.dropped == 0
            in_data = [(m.timestamp, m.is_historical) for m in total(watching, "NDATA")]
            live = [t_ms for t_ms, historical in in_data if not historical]
            assert live == sorted(set(live)), "no live sample is repeated"

    run(main(), LONG_S)


def total(watching: Host, *kinds: str) -> list:  # type: ignore[type-arg]
    """The metrics of the program's variable, in the order in which they arrived."""
    return [
        metric
        for message in list(watching.messages)
        if message.kind in (kinds or ("NBIRTH", "NDATA"))
        for metric in message.payload.metrics
        if metric.alias == 7
    ]


def test_a_node_waits_for_its_primary_host_and_dies_with_it(mosquitto: Mosquitto, tmp_path: Path) -> None:
    async def main() -> None:
        node = edge_node(host="scada")
        note_all(node, 2000)
        with host(mosquitto.port) as watching:
            async with published(node, at(mosquitto), tmp_path) as publisher:
                await eventually(lambda: "primary host" in publisher.error, within_s=40)
                assert watching.of("NBIRTH") == []
                await asyncio.to_thread(watching.say, online=True)
                await seen(watching, "DBIRTH", "fan")
                await asyncio.to_thread(watching.say, online=False, later_ms=-5)
                note(node, 3000, fan__mode=0)
                publisher.wake()
                await seen(watching, "DDATA", "fan")
                await asyncio.to_thread(watching.say, online=False)
                await seen(watching, "NDEATH")
                note(node, 4000, fan__mode=7)
                await eventually(lambda: "primary host" in publisher.error and publisher.is_connected, within_s=40)
                await asyncio.to_thread(watching.say, online=True, later_ms=10)
                await seen(watching, "NBIRTH", count=2)
                assert [value_of(m.by_name["bdSeq"]) for m in watching.of("NBIRTH")] == [0, 1]

    run(main(), LONG_S)


def test_commands_reach_the_gateway_and_damaged_ones_are_counted(mosquitto: Mosquitto, tmp_path: Path) -> None:
    async def main() -> None:
        node = edge_node(writes=True)
        note_all(node, 2000)
        decided: list[WriteRequest] = []

        async def decide(request: WriteRequest) -> bool:
            decided.append(request)
            return False

        with host(mosquitto.port) as watching:
            async with published(node, at(mosquitto), tmp_path, decide) as publisher:
                await connected(publisher)
                await seen(watching, "DBIRTH", "fan")
                await asyncio.to_thread(watching.command, "fan", mode=2)
                await asyncio.to_thread(watching.command, "fan", speed=2)
                await asyncio.to_thread(watching.raw, "spBv1.0/plant/DCMD/hall/fan", b"\x12\xff")
                await eventually(lambda: len(decided) == 2 and publisher.garbled == 1, within_s=40)
                assert decided[0] == WriteRequest("fan.mode", 2.0)
                assert decided[1].refusal == "the command names no tag of a device"
                await eventually(lambda: node.counters["commands_refused"] == 2)

    run(main(), LONG_S)


def test_json_is_retained_with_the_status_of_the_server(mosquitto: Mosquitto, tmp_path: Path) -> None:
    def retained() -> dict[str, bytes]:
        """The retained messages, as a client that connects now gets them."""
        found: dict[str, bytes] = {}
        client = paho.Client(paho.CallbackAPIVersion.VERSION2)
        client.on_message = lambda _, __, m: found.update({m.topic: m.payload}) if m.retain else None
        client.connect("127.0.0.1", mosquitto.port)
        client.subscribe("hall/#", 1)
        end = time.monotonic() + 20
        while len(found) <= len(GOOD) and time.monotonic() < end:
            client.loop(0.05)
        client.disconnect()
        return found

    async def main() -> None:
        publication = json_messages(JsonConfig("{system}/{device}/{tag}", "hall/status"))
        note_all(publication, 2000)
        async with published(publication, at(mosquitto), tmp_path) as publisher:
            await connected(publisher)
            found = await asyncio.to_thread(retained)
            assert found["hall/status"] == b"online"
            assert json.loads(found["hall/sensor/offset"])["value"] == -5
        assert (await asyncio.to_thread(retained))["hall/status"] == b"offline"

    run(main(), LONG_S)


@pytest.fixture(scope="module")
def pki(tmp_path_factory: pytest.TempPathFactory) -> Pki:
    if shutil.which("openssl") is None:
        pytest.skip("openssl makes the certificates")
    return make_pki(tmp_path_factory.mktemp("pki"))


def test_user_password_and_tls_are_used_and_a_wrong_password_is_reported(
    tmp_path: Path, pki: Pki, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(publisher_module, "LIMIT_S", 0.5)
    program()  # skips if it is missing
    passwords = tmp_path / "passwords"
    tool = shutil.which("mosquitto_passwd") or "mosquitto_passwd"
    subprocess.run([tool, "-b", "-c", passwords, "plant", "plant-word"], check=True, capture_output=True)
    passwords.chmod(0o600)
    settings = (
        f"cafile {pki.ca}", f"certfile {pki.cert('server')}", f"keyfile {pki.key('server')}", "allow_anonymous false",
        f"password_file {passwords}",
    )  # fmt: skip

    async def main() -> None:
        with broker(tmp_path, *settings) as here:
            word = tmp_path / "word"
            word.write_text("wrong-word\n")
            monkeypatch.setenv("FIELDTWIN_MQTT_PASSWORD_FILE", str(word))
            url = BrokerUrl("127.0.0.1", here.port, "plant", tls=True, files={"ca": pki.ca})
            node = edge_node()
            note_all(node, 2000)
            async with published(node, url, tmp_path) as publisher:
                await eventually(lambda: "refuses the connection: Not authorized" in publisher.error, within_s=40)
                assert "wrong-word" not in publisher.error
                word.write_text("plant-word\n")  # the next attempt reads it again
                await connected(publisher)
                assert node.counters["births"] == 1

    run(main(), LONG_S)


def test_a_missing_broker_is_reported_and_samples_are_kept(tmp_path: Path) -> None:
    async def main() -> None:
        node = edge_node()
        async with published(node, BrokerUrl("127.0.0.1", 9), tmp_path) as publisher:
            await eventually(lambda: "the broker cannot be reached" in publisher.error, within_s=40)
            note_all(node, 2000)
            assert node.backlog.waiting == 7

    run(main(), LONG_S)
