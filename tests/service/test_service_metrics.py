"""Metrics of a run: read back by Prometheus's own parser, from statuses of gateway and PLC, and over a real socket."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from typing import Any

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from prometheus_client.parser import text_string_to_metric_families
from statuses import gateway_status
from support import run

from fieldtwin.gateway.core.errors import EndpointBusy, UsageError
from fieldtwin.gateway.core.histogram import RESPONSE_MS, response_times
from fieldtwin.gateway.runtime.buses.bus import latency_status
from fieldtwin.gateway.runtime.gateway_status import GatewayStatus
from fieldtwin.plc.status import ChangesStatus, PlcStatus, Spread, TaskStatus
from fieldtwin.service.exposition import CONTENT_TYPE, Family, render
from fieldtwin.service.metric_families import ALL
from fieldtwin.service.metrics import MOST_DEVICES, OLDEST_STATUS_S, RunState, families
from fieldtwin.service.metrics_server import MOST_CLIENTS, MetricsServer, parse_place
from fieldtwin.twin.site.exported_tags import ExportedTag
from fieldtwin.twin.thread.status import PlantThreadStatus

THREAD = PlantThreadStatus(
    carrier="tcp", connected=True, links=1, origin="plant", sent_through=7, waiting=0, resent=0, duplicates=0, silent="",
    trouble="", place="tcp://127.0.0.1:1", written=7, dropped=3, store_trouble="", commands_taken=0, commands_refused=0,
    since_ms=0, received={},
)  # fmt: skip


def busy_gateway(devices: int = 1) -> GatewayStatus:
    latency = response_times()
    latency.record(3_000_000)
    latency.record(9_000_000_000)
    counted = {"polls": 7, "errors": 2}
    node = {"boots": 3, "emcys": 1, "tpdos": {"1": {"cob_id": "185h", "tags": [], "frames": 5}}, "rpdos_sent": 4}
    return gateway_status(
        devices={
            **{f"ctd{i}": counted for i in range(devices)},
            "tilt": {**counted, **node, "bus": "can0", "online": False},
        },
        buses={
            "line1": {
                "opens": 2,
                "counters": {"requests": 9, "timeouts": 1},
                "latency": msgspec.to_builtins(latency_status(latency)),
            },
            "can0": {
                "connected": False,
                "error": "down",
                "counters": {"pdos": 5},
                "not_produced": 6,
                "sync_producers": "",
            },
        },
        tags={
            "ctd.pressure": {"value": 31337.25, "age_s": 0.5},
            "ctd.secret": {"value": "geheim", "quality": "bad"},
        },
        outputs=[{"tag": "ctd.period", "wanted": 2, "held": 1}],
        writes={"done": 1, "failed": 2, "refused": 3, "repeated": 4, "safe": True},
        mailboxes={
            "modem": {
                "received": 1,
                "sent": 2,
                "taken": 3,
                "waits": 4,
                "queued": 5,
                "dropped": 6,
                "commands_refused": 7,
            }
        },
        plc={"losses": 1},
        serve={"hmi": {"listening": "tcp://x:1", "error": "", "counters": {"requests": 11}, "unit": 1}},
        published=83,
        logged=2,
        log_dropped=1,
        config={
            "system": "observatory",
            "hash": "ab12",
            "reloads": 3,
            "changed": ["devices.ctd0.poll.values.every_ms: 500 -> 250"],
        },
    )


SHAPE: Spread = {"count": 4, "min": 1.0, "p50": 10.0, "p99": 20.0, "p999": 30.0, "above_1ms": 0.0, "max": 40.0}
PLAIN_TASK: dict[str, Any] = {"state": "running", "lateness_us": SHAPE, "duration_us": SHAPE}


def plc_status() -> PlcStatus:
    task: dict[str, Any] = {**PLAIN_TASK, "scans": 442, "missed_periods": 1, "overruns": 2}
    forces: dict[str, dict[str, Any]] = {"a": {"value": 1}}
    tasks = {"main": TaskStatus(**task)}
    return PlcStatus(
        **task, tasks=tasks, restarts=3, changes=ChangesStatus(count=2), forces=forces, counters={"messages_missed": 2}
    )


def seen(**changed: Any) -> RunState:
    whole = RunState("observatory", "plant", 12.5, busy_gateway(), plc_status(), {"gateway": True, "plc": True}, 0.1)
    return replace(whole, **changed)


PRESSURE = ExportedTag("ctd", "pressure", "dbar")


def whole() -> RunState:
    """Return a state in which every metric has a sample."""
    return seen(thread=THREAD, exported_tags=(PRESSURE, ExportedTag("ctd", "missing", "")))


def scraped(text: str) -> dict[tuple[str, frozenset[tuple[str, str]]], float]:
    """Return every sample by name and labels; this also tests that the parser accepts it, and that none occurs twice."""
    found: dict[tuple[str, frozenset[tuple[str, str]]], float] = {}
    for family in text_string_to_metric_families(text):
        for sample in family.samples:
            key = (sample.name, frozenset(sample.labels.items()))
            assert key not in found
            found[key] = sample.value
    return found


def value(samples: dict[Any, float], name: str, /, **labels: str) -> float:
    return samples[f"fieldtwin_{name}", frozenset(labels.items())]


def test_metrics_for_maintainers_exist() -> None:
    got = scraped(render(families(seen())))
    assert value(got, "up", process="gateway") == 1
    assert value(got, "bus_events_total", bus="line1", event="requests") == 9
    assert value(got, "bus_events_total", bus="line1", event="crc_errors") == 0  # a rate needs it before the first
    assert value(got, "bus_events_total", bus="can0", event="pdos") == 5
    assert value(got, "bus_not_produced_total", bus="can0") == 6
    assert value(got, "bus_connected", bus="can0") == 0
    assert value(got, "device_online", device="tilt", bus="can0") == 0
    assert value(got, "device_pdos_total", device="tilt", bus="can0", direction="out") == 4
    assert value(got, "devices_online") == 1
    assert [value(got, "tags", quality=q) for q in ("good", "bad", "uncertain")] == [1, 1, 0]
    assert value(got, "writes_total", result="refused") == 3
    assert value(got, "outputs_pending") == 1
    assert value(got, "mailbox_messages_total", device="modem", what="dropped") == 6
    assert value(got, "server_events_total", kind="serve", name="hmi", event="requests") == 11
    assert value(got, "plc_overruns_total", task="main") == 2
    assert value(got, "plc_lateness_seconds", task="main", quantile="0.99") == pytest.approx(20e-6)
    assert value(got, "plc_restarts_total") == 3
    assert value(got, "plc_changes_total") == 2


SERIES = """
fieldtwin_bus_connected gauge bus
fieldtwin_bus_events_total counter bus,event
fieldtwin_bus_latency_seconds_bucket histogram bus,le
fieldtwin_bus_latency_seconds_count histogram bus
fieldtwin_bus_latency_seconds_sum histogram bus
fieldtwin_bus_not_produced_total counter bus
fieldtwin_bus_opens_total counter bus
fieldtwin_device_boots_total counter bus,device
fieldtwin_device_emcys_total counter bus,device
fieldtwin_device_errors_total counter bus,device
fieldtwin_device_online gauge bus,device
fieldtwin_device_pdos_total counter bus,device,direction
fieldtwin_device_polls_total counter bus,device
fieldtwin_device_wrong gauge bus,device
fieldtwin_devices gauge
fieldtwin_devices_left_out gauge
fieldtwin_devices_online gauge
fieldtwin_devices_wrong gauge
fieldtwin_info gauge mode,system,version
fieldtwin_log_dropped_total counter
fieldtwin_logged_total counter
fieldtwin_mailbox_messages_total counter device,what
fieldtwin_mailbox_queued gauge device
fieldtwin_outputs_pending gauge
fieldtwin_outputs_safe gauge
fieldtwin_plc_alive gauge
fieldtwin_plc_changes_total counter
fieldtwin_plc_events_total counter event
fieldtwin_plc_forces gauge
fieldtwin_plc_lateness_seconds summary quantile,task
fieldtwin_plc_losses_total counter
fieldtwin_plc_missed_periods_total counter task
fieldtwin_plc_overruns_total counter task
fieldtwin_plc_period_seconds gauge task
fieldtwin_plc_programs_waiting gauge
fieldtwin_plc_restarts_total counter
fieldtwin_plc_running gauge task
fieldtwin_plc_scan_seconds summary quantile,task
fieldtwin_plc_scans_total counter task
fieldtwin_plc_state gauge state,task
fieldtwin_published_total counter
fieldtwin_reloads_total counter
fieldtwin_run_seconds gauge
fieldtwin_server_events_total counter event,kind,name
fieldtwin_status_age_seconds gauge
fieldtwin_store_ok gauge
fieldtwin_tag_good gauge device,tag
fieldtwin_tag_problem gauge device,reason,tag
fieldtwin_tag_value gauge device,tag,unit
fieldtwin_tags gauge quality
fieldtwin_tags_oldest_seconds gauge
fieldtwin_thread_dropped_total counter
fieldtwin_up gauge process
fieldtwin_writes_allowed gauge
fieldtwin_writes_total counter result
"""
"""Name, type and labels of every series. Users have dashboards and alerts for them: a change breaks those."""


def test_names_types_and_labels_are_those_that_dashboards_use() -> None:
    found = {
        " ".join((sample.name, family.type, ",".join(sorted(sample.labels)))).rstrip()
        for family in text_string_to_metric_families(render(families(whole())))
        for sample in family.samples
    }
    assert sorted(found) == sorted(SERIES.split("\n")[1:-1])


def test_each_metric_has_the_labels_that_its_declaration_states() -> None:
    page = {family.name: family for family in families(whole())}
    assert page.keys() == {declared.name for declared in ALL}
    for declared in ALL:
        family = page[declared.name]
        extra = {"le"} if declared.kind == "histogram" else set()
        labels = {frozenset(labels) - extra for _, labels, _ in family.samples}
        assert labels == {frozenset(declared.labels)}, family.name


def test_bounds_of_buckets_are_written_as_dashboards_use_them() -> None:
    labels = [dict(labels) for name, labels in scraped(render(families(seen()))) if name.endswith("_bucket")]
    buckets = [found["le"] for found in labels if found["bus"] == "line1"]
    wanted = "0.001 0.002 0.005 0.01 0.02 0.05 0.1 0.2 0.5 1 2 5 +Inf"
    assert buckets == wanted.split()


def test_latency_is_a_histogram_whose_buckets_add_up() -> None:
    got = scraped(render(families(seen())))
    buckets = [value(got, "bus_latency_seconds_bucket", bus="line1", le=f"{ms / 1000:g}") for ms in RESPONSE_MS]
    assert buckets == [0, 0] + [1] * (len(RESPONSE_MS) - 2)
    assert value(got, "bus_latency_seconds_bucket", bus="line1", le="+Inf") == 2
    assert value(got, "bus_latency_seconds_count", bus="line1") == 2
    assert value(got, "bus_latency_seconds_sum", bus="line1") == pytest.approx(9.003)


def test_no_value_and_no_name_of_a_tag_is_in_it() -> None:
    text = render(families(seen()))
    assert "geheim" not in text
    assert "31337" not in text
    assert "pressure" not in text


def test_an_exported_tag_has_its_value_with_unit_and_no_other_tag_has_one() -> None:
    text = render(families(seen(exported_tags=(PRESSURE,))))
    got = scraped(text)
    assert value(got, "tag_value", device="ctd", tag="pressure", unit="dbar") == 31337.25
    assert value(got, "tag_good", device="ctd", tag="pressure") == 1
    assert not [name for name, _ in got if name == "fieldtwin_tag_problem"]
    assert "secret" not in text


@pytest.mark.parametrize(
    ("status", "changes", "reason"),
    [
        ({"quality": "bad", "reason": "stale"}, {}, "stale"),
        ({"quality": "uncertain", "reason": "out of range"}, {}, "out of range"),
        ({"quality": "simulated"}, {}, "none"),
        ({"value": None}, {}, "none"),
        ({}, {"gateway_ago_s": OLDEST_STATUS_S + 0.1}, "gateway dead"),
    ],
)
def test_a_value_that_is_not_good_has_no_sample_and_a_reason(
    status: dict[str, Any], changes: dict[str, Any], reason: str
) -> None:
    gateway = gateway_status(tags={"ctd.pressure": {"value": 31337.25, "age_s": 0.5} | status})
    got = scraped(render(families(seen(gateway=gateway, exported_tags=(PRESSURE,), **changes))))
    assert not [name for name, _ in got if name == "fieldtwin_tag_value"]
    assert value(got, "tag_good", device="ctd", tag="pressure") == 0
    assert value(got, "tag_problem", device="ctd", tag="pressure", reason=reason) == 1


def test_a_bit_is_exported_as_0_or_1_and_a_counter_of_64_bits_exactly() -> None:
    tags = (ExportedTag("d", "bit", ""), ExportedTag("d", "energy", "Wh"), ExportedTag("d", "missing", ""))
    gateway = gateway_status(tags={"d.bit": {"value": True}, "d.energy": {"value": 2**63 + 1}})
    text = render(families(seen(gateway=gateway, exported_tags=tags)))
    assert 'fieldtwin_tag_value{device="d",tag="bit",unit=""} 1\n' in text
    assert f'fieldtwin_tag_value{{device="d",tag="energy",unit="Wh"}} {2**63 + 1}\n' in text
    assert 'fieldtwin_tag_good{device="d",tag="missing"} 0\n' in text
    assert 'fieldtwin_tag_problem{device="d",tag="missing",reason="never read"} 1\n' in text


def test_the_state_of_a_task_is_1_for_its_present_state_only() -> None:
    got = scraped(render(families(seen())))
    states = {dict(labels)["state"]: n for (name, labels), n in got.items() if name == "fieldtwin_plc_state"}
    assert states == {"ready": 0, "running": 1, "paused": 0, "waiting": 0, "stopped": 0}


def test_a_task_that_an_event_starts_has_no_period() -> None:
    cyclic, event = TaskStatus(**PLAIN_TASK, cycle_ms=20.0), TaskStatus(**PLAIN_TASK, cycle_ms=1e9, single="ctd.alarm")
    plc = PlcStatus(**PLAIN_TASK, tasks={"fast": cyclic, "alarm": event})
    got = scraped(render(families(seen(plc=plc))))
    assert {dict(labels)["task"]: n for (name, labels), n in got.items() if name == "fieldtwin_plc_period_seconds"} == {
        "fast": 0.02
    }


def test_a_process_that_does_not_answer_is_down_and_has_no_metrics() -> None:
    got = scraped(render(families(seen(gateway=None, plc=None, children={"gateway": True, "plc": False}))))
    assert value(got, "up", process="gateway") == 0
    assert value(got, "up", process="plc") == 0
    assert not [name for name, _ in got if name.startswith(("fieldtwin_bus", "fieldtwin_plc", "fieldtwin_tags"))]


def test_series_are_bounded() -> None:
    got = scraped(render(families(seen(gateway=busy_gateway(MOST_DEVICES + 4)))))
    assert sum(name == "fieldtwin_device_online" for name, _ in got) == MOST_DEVICES
    assert value(got, "devices_left_out") == 5
    assert value(got, "devices") == MOST_DEVICES + 5


@settings(max_examples=60)
@given(
    st.text(st.characters(codec="utf-8", exclude_characters="\r\x0b\x0c\x1c\x1d\x1e\x85\u2028\u2029")),
    st.floats(allow_nan=False),
)
def test_any_label_and_any_number_are_read_back_unchanged(label: str, number: float) -> None:
    family = Family("x", "gauge", "back\\slash\nand line")
    family.add(number, name=label)
    assert scraped(render([family])) == {("x", frozenset({("name", label)})): number}


@pytest.mark.parametrize(
    ("text", "place"),
    [
        ("9464", ("127.0.0.1", 9464)),
        (":9464", ("127.0.0.1", 9464)),
        ("10.0.0.1:1", ("10.0.0.1", 1)),
        ("[::1]:9464", ("::1", 9464)),
    ],
)
def test_without_a_host_it_is_loopback(text: str, place: tuple[str, int]) -> None:
    assert parse_place(text) == place


@pytest.mark.parametrize("text", ["", "host", "host:", "1:2:3", "x:70000", "http://x:1"])
def test_invalid_addresses_of_the_metrics_server_are_refused(text: str) -> None:
    with pytest.raises(UsageError):
        parse_place(text)


async def ask(url: str, request: bytes) -> tuple[str, str]:
    port = int(url.split(":")[2].split("/")[0])
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    writer.write(request)
    try:
        head, _, body = (await reader.read()).decode().partition("\r\n\r\n")
        writer.close()
        await writer.wait_closed()
    except ConnectionResetError:
        return "", ""
    return head, body


def test_the_metrics_server_answers_a_scrape() -> None:
    async def main() -> None:
        server = MetricsServer(lambda: render(families(seen())))
        url = await server.open("127.0.0.1", 0)
        try:
            head, body = await ask(url, b"GET /metrics HTTP/1.1\r\nHost: x\r\n\r\n")
            assert head.startswith("HTTP/1.1 200")
            assert f"Content-Type: {CONTENT_TYPE}" in head
            assert value(scraped(body), "published_total") == 83
            assert (await ask(url, b"HEAD /metrics HTTP/1.1\r\n\r\n"))[1] == ""
            assert "404" in (await ask(url, b"GET / HTTP/1.1\r\n\r\n"))[0]
            assert "405" in (await ask(url, b"POST /metrics HTTP/1.1\r\n\r\n"))[0]
            assert "400" in (await ask(url, b"\x00\x01\r\n\r\n"))[0]
            assert (await ask(url, b"GET /" + b"x" * 20_000 + b"\r\n\r\n"))[0] == ""  # more than it reads
            assert server.served == 2
            second = MetricsServer(str)
            with pytest.raises(EndpointBusy):
                await second.open("127.0.0.1", int(url.split(":")[2].split("/")[0]))
        finally:
            await server.aclose()

    run(main())


def test_idle_clients_take_no_more_than_their_share() -> None:
    async def main() -> None:
        server = MetricsServer(str)
        url = await server.open("127.0.0.1", 0)
        port = int(url.split(":")[2].split("/")[0])
        idle = [await asyncio.open_connection("127.0.0.1", port) for _ in range(MOST_CLIENTS)]
        try:
            assert (await ask(url, b"GET /metrics HTTP/1.1\r\n\r\n"))[0] == ""
            assert server.refused == 1
        finally:
            await server.aclose()  # does not wait for them
            for _, writer in idle:
                writer.close()
                await writer.wait_closed()

    run(main())
