"""Servers of kind `mqtt` of a real run: values, faults, commands under the rules of the run, status, and the end of the run."""

from __future__ import annotations

import json
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import paho.mqtt.client as paho
import pytest
from local_mosquitto import Mosquitto, broker
from procs import Fieldtwin, fieldtwin, no_tracebacks, wait_for
from served_hall import FILES
from sparkplug_host import Host, host, property_of, value_of

pytestmark = [pytest.mark.interop, pytest.mark.long, pytest.mark.timeout(240)]
WITHIN_S = 90.0
SERVE = """\
serve:
  scada: {kind: mqtt, url: "mqtt://127.0.0.1:%(port)d", every_ms: 50, sparkplug: {group: plant, node: hall, writes: true}}
  dashboard: {kind: mqtt, url: "mqtt://127.0.0.1:%(port)d", every_ms: 50, json: {topic: "hall/{device}/{tag}", status: "hall"}}
alarms:
  limit_high: {condition: "fan.limit > 50"}
"""


@pytest.fixture(scope="module")
def hall(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Fieldtwin, Mosquitto, Host]]:
    folder = tmp_path_factory.mktemp("h")
    with broker(folder) as mosquitto, host(mosquitto.port, node="hall-prototype") as watching:
        for name, text in FILES.items():
            served = text.partition("serve:")[0] + SERVE % {"port": mosquitto.port} if name == "hall.yaml" else text
            (folder / name).write_text(served, encoding="utf-8")
        with fieldtwin(folder, "run", str(folder / "hall.yaml"), "--prototype") as run:
            watching.until(lambda: watching.of("DBIRTH", "sensor") and watching.of("DBIRTH", "fan"), "births", WITHIN_S)
            yield run, mosquitto, watching
    no_tracebacks(folder)


def births(watching: Host, device: str) -> dict[str, Any]:
    return watching.of("DBIRTH", device)[-1].by_name


def test_births_have_the_values_types_and_units_of_the_profile(hall: tuple[Fieldtwin, Mosquitto, Host]) -> None:
    _, _, watching = hall

    def complete() -> dict[str, Any]:
        """Births until all values were read once."""
        sensor = births(watching, "sensor")
        if value_of(sensor["serial"]) is None or value_of(sensor["flow"]) is None:
            watching.command(Node_Control__Rebirth=True)
            time.sleep(0.5)
            return {}
        return sensor

    sensor = watching.until(complete, "a birth with all values", WITHIN_S)
    assert (value_of(sensor["flow"]), value_of(sensor["serial"]), value_of(sensor["state"])) == (12.5, "SN-0042", 7)
    assert {name: m.datatype for name, m in sensor.items()} == {
        "temperature": 9, "flow": 10, "ticks": 7, "state": 6, "serial": 12,
    }  # fmt: skip
    assert "code" not in sensor, "the tag is secret"
    assert (property_of(sensor["flow"], "engUnit"), property_of(sensor["flow"], "Quality")) == ("l/min", 192)
    node = watching.of("NBIRTH")[-1].by_name
    assert value_of(node["control/mode"]) == 2
    now_ms = time.time() * 1000
    assert all(abs(m.timestamp - now_ms) < 120_000 for m in sensor.values())


def test_a_silent_device_dies_and_returns(hall: tuple[Fieldtwin, Mosquitto, Host]) -> None:
    run, _, watching = hall
    field = run.control("hall", "field")
    before = len(watching.of("DBIRTH", "sensor"))
    field("fault", fault={"id": "f", "name": "silence", "device": "sensor"})
    watching.until(lambda: watching.of("DDEATH", "sensor"), "DDEATH", WITHIN_S)
    field("clear", id="f")
    watching.until(lambda: len(watching.of("DBIRTH", "sensor")) > before, "DBIRTH", WITHIN_S)
    assert watching.of("DDEATH", "fan") == []


def audit(run: Fieldtwin) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (run.root / "hall" / "audit.jsonl").read_text().splitlines()]


def test_a_command_is_carried_out_only_for_a_writable_tag_that_no_program_commands(
    hall: tuple[Fieldtwin, Mosquitto, Host],
) -> None:
    run, _, watching = hall
    by = "mqtt scada"
    watching.command("fan", lamp=True)
    field = run.control("hall", "field")
    assert field("ready")["ready"]
    watching.until(
        lambda: [e for e in audit(run) if e["by"] == by and e["device"] == "fan" and e["result"] == "done"],
        "the write of the lamp in the audit log",
        WITHIN_S,
    )
    lamp = list(births(watching, "fan")).index("lamp")
    alias = births(watching, "fan")["lamp"].alias
    assert lamp >= 0
    watching.until(
        lambda: [
            m for d in watching.of("DDATA", "fan") for m in d.payload.metrics if m.alias == alias and m.boolean_value
        ],
        "the new value of the lamp",
        WITHIN_S,
    )
    watching.command("fan", mode=1)  # an output of the program
    watching.command("sensor", flow=1.0)  # read-only
    watching.command("sensor", code=1)  # secret, so that it has no metric
    watching.until(
        lambda: (
            {e.get("tag") for e in audit(run) if e["by"] == by and e["action"] == "refuse"}
            >= {"fan.mode", "sensor.flow", "unknown"}
        ),
        "three refusals in the audit log",
        WITHIN_S,
    )
    gateway = run.control("hall", "gateway")
    watching.until(
        lambda: gateway("get", brief=True)["serve"]["scada"]["counters"]["commands_refused"] >= 3, "the counter"
    )


def test_the_status_of_the_gateway_shows_broker_and_counters(hall: tuple[Fieldtwin, Mosquitto, Host]) -> None:
    run, mosquitto, _ = hall
    gateway = run.control("hall", "gateway")
    url = f"mqtt://127.0.0.1:{mosquitto.port}"

    def statuses() -> dict[str, Any]:
        found: dict[str, Any] = gateway("get", brief=True)["serve"]
        return found if all(server["listening"] for server in found.values()) else {}

    found = wait_for(statuses, WITHIN_S, "both servers")
    assert found["scada"]["listening"] == f"{url} Sparkplug plant/hall-prototype"
    assert found["dashboard"]["listening"] == f"{url} JSON prototype/hall"
    assert found["scada"]["kind"] == "mqtt"
    assert found["scada"]["counters"]["births"] >= 1
    assert found["scada"]["counters"]["sent"] > 0
    assert found["scada"]["counters"]["dropped"] == 0


def test_the_state_of_an_alarm_is_published_and_is_null_while_it_is_not_known(
    hall: tuple[Fieldtwin, Mosquitto, Host],
) -> None:
    run, mosquitto, watching = hall
    field, messages = run.control("hall", "field"), list[dict[str, Any]]()
    client = paho.Client(paho.CallbackAPIVersion.VERSION2)
    client.on_message = lambda _, __, m: messages.append(json.loads(m.payload))
    client.connect("127.0.0.1", mosquitto.port)
    client.subscribe("prototype/hall/alarm/limit_high", 1)
    client.loop_start()

    def last(value: str | None, quality: str) -> bool:
        return bool(messages) and (messages[-1]["value"], messages[-1]["quality"]) == (value, quality)

    try:
        watching.until(lambda: last("normal", "good"), "the alarm is normal", WITHIN_S)
        field("set", device="fan", tag="limit", value=60.0)
        watching.until(lambda: last("active_unacknowledged", "good"), "the alarm is active", WITHIN_S)
        field("fault", fault={"id": "f", "name": "silence", "device": "fan"})
        watching.until(lambda: last(None, "bad"), "the alarm is not known", WITHIN_S)
        field("clear", id="f")
        watching.until(lambda: last("active_unacknowledged", "good"), "the alarm is active again", WITHIN_S)
        field("set", device="fan", tag="limit", value=None)
        metric = watching.of("NBIRTH")[-1].by_name["alarm/limit_high"]
        assert metric.datatype == 12  # String
    finally:
        client.disconnect()
        client.loop_stop()


def test_the_end_of_the_run_is_the_death_of_the_node(hall: tuple[Fieldtwin, Mosquitto, Host]) -> None:
    """The last test of this module, because it ends the run."""
    run, mosquitto, watching = hall
    found: dict[str, bytes] = {}
    client = paho.Client(paho.CallbackAPIVersion.VERSION2)
    client.on_message = lambda _, __, m: found.update({m.topic: m.payload})
    client.connect("127.0.0.1", mosquitto.port)
    client.subscribe("prototype/#", 1)
    client.loop_start()
    try:
        flow = "prototype/hall/sensor/flow"
        watching.until(lambda: flow in found and "prototype/hall" in found, "messages in JSON", WITHIN_S)
        assert json.loads(found[flow])["unit"] == "l/min"
        assert found["prototype/hall"] == b"online"
        run.signal(signal.SIGINT)
        run.wait()
        watching.until(lambda: watching.of("NDEATH"), "NDEATH")
        watching.until(lambda: found["prototype/hall"] == b"offline", "the status")
    finally:
        client.disconnect()
        client.loop_stop()


NUMBERS = {
    "tank.yaml": """\
device: mysite/tank
source: "made for this test: numbers only"
protocol: modbus
tags:
  level: {at: 30001, type: float32, unit: m, poll: fast}
""",
    "pump.yaml": """\
fieldtwin: 1
system: pump
buses: {lan: {url: "tcp://192.0.2.1:502"}}
devices: {tank: {profile: ./tank.yaml, bus: lan, unit: 1, poll: {fast: {every_ms: 100}}}}
serve:
  scada: {kind: mqtt, url: "mqtt://127.0.0.1:%(port)d", every_ms: 50, sparkplug: {group: plant}}
""",
    "pump.prototype.yaml": """\
prototype_of: pump.yaml
buses: {lan: {listen: "tcp://127.0.0.1:0"}}
devices: {tank: {model: profile, values: {level: 1.5}}}
""",
}


def test_a_system_without_texts_stays_connected(tmp_path: Path) -> None:
    """Defect: the task for texts ended at once, and with it the process; the run started it again and again."""
    with broker(tmp_path) as mosquitto, host(mosquitto.port, node="pump-prototype") as watching:
        for name, text in NUMBERS.items():
            (tmp_path / name).write_text(text.replace("%(port)d", str(mosquitto.port)), encoding="utf-8")
        with fieldtwin(tmp_path, "run", str(tmp_path / "pump.yaml"), "--prototype") as run:
            watching.until(lambda: watching.of("DBIRTH", "tank"), "the birth of the tank", WITHIN_S)
            alias = births(watching, "tank")["level"].alias
            field = run.control("pump", "field")
            for level in (2.5, 3.5):
                field("set", device="tank", tag="level", value=level)
                watching.until(
                    lambda level=level: [
                        m
                        for data in watching.of("DDATA", "tank")
                        for m in data.payload.metrics
                        if m.alias == alias and value_of(m) == level
                    ],
                    f"a level of {level} m",
                    WITHIN_S,
                )
            assert (len(watching.of("NBIRTH")), watching.of("NDEATH")) == (1, [])
    no_tracebacks(tmp_path)
