"""A server of kind `mqtt` in a system file: its defaults, its names in a prototype, and errors with their places."""

from __future__ import annotations

from pathlib import Path

import pytest

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.northbound.mqtt.publications import publication_of
from fieldtwin.northbound.mqtt.served_tags import served_tags
from fieldtwin.twin.site.servers.serving_mqtt import JsonConfig, SparkplugConfig
from fieldtwin.twin.site.system import System, load_system

SYSTEM = """\
fieldtwin: 1
system: site
buses: {lan: {url: "tcp://192.0.2.1:502"}}
devices: {meter: {profile: eastron-sdm630, bus: lan, unit: 1}}
serve:
"""
URL = 'url: "mqtt://127.0.0.1"'


def load(folder: Path, server: str) -> System:
    path = folder / "site.yaml"
    path.write_text(f"{SYSTEM}  scada: {server}\n", encoding="utf-8")
    return load_system(str(path))


def test_an_edge_node_has_the_name_of_the_system_and_its_files_are_next_to_the_system_file(tmp_path: Path) -> None:
    url = 'url: "mqtts://plant@broker.example?ca=ca.pem"'
    [server] = load(tmp_path, f"{{kind: mqtt, {url}, sparkplug: {{group: plant}}}}").serving.mqtt
    assert server.sparkplug == SparkplugConfig("plant", "site", "", writes=False)
    assert (server.url, server.broker.user) == ("mqtts://broker.example:8883", "plant")
    assert server.broker.files == {"ca": str(tmp_path / "ca.pem")}
    assert (server.every_ms, server.buffer_samples, server.buffer_bytes) == (1000, 10_000, 4 << 20)


def test_json_has_topics_by_default(tmp_path: Path) -> None:
    [server] = load(tmp_path, f"{{kind: mqtt, {URL}, json: {{publish: interval}}}}").serving.mqtt
    assert server.json == JsonConfig("fieldtwin/{system}/{device}/{tag}", "fieldtwin/{system}/status", interval=True)


@pytest.mark.parametrize(
    ("instance", "node", "status"),
    [
        ("site", "Sparkplug plant/site-prototype", "JSON prototype/fieldtwin/site/status"),
        ("two", "Sparkplug plant/site-prototype-two", "JSON prototype-two/fieldtwin/site/status"),
    ],
)
def test_a_prototype_cannot_be_taken_for_the_plant(tmp_path: Path, instance: str, node: str, status: str) -> None:
    file = f"{{kind: mqtt, {URL}, sparkplug: {{group: plant}}}}\n  ha: {{kind: mqtt, {URL}, json: {{}}}}"
    system = load(tmp_path, file)
    tags = served_tags(system)

    servers = system.serving.mqtt
    assert [publication_of(each, "site", instance, tags, 0).place for each in servers] == [
        "Sparkplug plant/site", "JSON fieldtwin/site/status",
    ]  # fmt: skip
    assert [publication_of(each.for_prototype(), "site", instance, tags, 0).place for each in servers] == [node, status]


@pytest.mark.parametrize(
    ("server", "at", "text"),
    [
        (f"{{kind: mqtt, {URL}}}", "scada", "expected either `sparkplug` or `json`"),
        (
            f"{{kind: mqtt, {URL}, json: {{}}, sparkplug: {{group: g}}}}",
            "scada",
            "expected either `sparkplug` or `json`",
        ),
        (f"{{kind: mqtt, {URL}, sparkplug: {{}}}}", "sparkplug", "the key 'group' is missing"),
        (f"{{kind: mqtt, {URL}, sparkplug: {{group: a/b}}}}", "group:", "a word without"),
        (f"{{kind: mqtt, {URL}, sparkplug: {{group: a, host: 'b+'}}}}", "host:", "a word without"),
        ("{kind: mqtt, json: {}}", "scada", "the key 'url' is missing"),
        ('{kind: mqtt, url: "http://broker", json: {}}', "url", "expected mqtt://"),
        ('{kind: mqtt, url: "mqtt://u:secret@broker", json: {}}', "url", "password"),
        ('{kind: mqtt, url: "mqtt://broker/a/b", json: {}}', "url", "no path"),
        ('{kind: mqtt, url: "mqtt://broker?ca=x", json: {}}', "url", "certificates need mqtts://"),
        (f"{{kind: mqtt, {URL}, json: {{topic: 'a/{{tag}}'}}}}", "topic:", "no {device}"),
        (f"{{kind: mqtt, {URL}, json: {{topic: 'a/{{device}}/{{tga}}'}}}}", "topic:", "{tga} is not known"),
        (f"{{kind: mqtt, {URL}, json: {{topic: 'a/{{device.x}}/{{tag}}'}}}}", "topic:", "{device.x} is not known"),
        (f"{{kind: mqtt, {URL}, json: {{topic: 'a/+/{{device}}/{{tag}}'}}}}", "topic:", "not a topic"),
        (f"{{kind: mqtt, {URL}, json: {{status: 'a/{{device}}'}}}}", "status:", "{device} is not known"),
        (f"{{kind: mqtt, {URL}, json: {{status: 'a/{{'}}}}", "status:", "not a topic"),
        (f"{{kind: mqtt, {URL}, json: {{}}, every_ms: 1}}", "every_ms", "at least 10"),
    ],
)
def test_an_error_states_its_place(tmp_path: Path, server: str, at: str, text: str) -> None:
    with pytest.raises(FileInvalid) as caught:
        load(tmp_path, server)
    assert text in str(caught.value)
    line = f"  scada: {server}"
    assert f"site.yaml:6:{line.index(at) + 1}:" in str(caught.value)
