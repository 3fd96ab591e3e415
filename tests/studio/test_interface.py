"""The REST and WebSocket interface, used with clients that are not ours: httpx and websockets."""

from __future__ import annotations

import asyncio
import json
import shutil
from pathlib import Path
from typing import Any

import httpx
import pytest
import websockets
from msgspec import structs
from studio_rig import OPERATE, VIEW, Studio, until

from fieldtwin.capture.formats.packet_file import PacketFile
from fieldtwin.capture.formats.pcap import MAGIC_NS
from fieldtwin.emulators.virtual.clock import EPOCH_UTC_NS
from fieldtwin.gateway.core.files.recording import RecordingReader
from fieldtwin.run.processes.run_record import SYSTEM_FILE, read_record, write_record

NAME = "/instances/observatory"


def tag(studio: Studio, name: str) -> dict[str, Any]:
    with studio.client(VIEW) as client:
        found: dict[str, Any] = client.get(f"{NAME}/tags").json()[name]
        return found


def latest(client: httpx.Client, **wanted: Any) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = client.get(f"{NAME}/frames", params=wanted | {"count": 50}).json()["rows"]
    return rows


def test_a_started_prototype_is_listed_and_described(observatory: Studio) -> None:
    with observatory.client(VIEW) as client:
        [listed] = [i for i in client.get("/instances").json() if i["name"] == "observatory"]
        assert listed["running"]
        assert listed["mode"] == "prototype"
        assert listed["started_here"]
        assert listed["frames"]
        about = client.get(NAME).json()
    assert about["system"]["devices"]["ctd"]["tags"]["pressure"]["unit"] == "dbar"
    assert about["role"] == "view"
    assert about["system"]["buses"]["can0"]["kind"] == "CAN bus"


def test_a_silent_device_turns_bad_with_its_reason_and_recovers(observatory: Studio) -> None:
    until(lambda: tag(observatory, "ctd.status")["quality"] == "good", "the sensor is read")
    with observatory.client() as client:
        injected = client.post(f"{NAME}/faults", json={"fault": {"name": "silence", "device": "ctd"}}).json()
        bad = until(lambda: (t := tag(observatory, "ctd.status"))["quality"] == "bad" and t, "the status turns bad")
        assert bad["reason"] in ("timeout", "stale")
        problems = until(
            lambda: client.get(f"{NAME}/frames", params={"device": "ctd", "problems": True}).json()["rows"],
            "unanswered requests are shown as problems",
        )
        assert {row["verdict"] for row in problems} == {"no reply"}
        counted = until(
            lambda: [
                f for f in client.get(f"{NAME}/faults").json()["history"] if f["id"] == injected["id"] and f["struck"]
            ],
            "the fault is counted",
        )
        assert counted[0]["name"] == "silence"
        client.delete(f"{NAME}/faults/{injected['id']}").raise_for_status()
    until(lambda: tag(observatory, "ctd.status")["quality"] == "good", "the sensor is read again")


def test_a_value_set_in_the_simulated_device_arrives_over_the_bus_until_it_is_released(observatory: Studio) -> None:
    with observatory.client() as client:
        client.put(f"{NAME}/tags/ctd.sample_period_s/set", json={"value": 7}).raise_for_status()
        until(lambda: tag(observatory, "ctd.sample_period_s")["value"] == 7, "the set value is read")
        until(
            lambda: 7 in [row["tags"].get("sample_period_s") for row in latest(client, device="ctd")],
            "the frame that carried the value is shown",
        )
        history = f"{NAME}/tags/ctd.sample_period_s/history"
        until(lambda: client.get(history).json()["points"][-1][1:3] == [7, "good"], "the history has the set value")
        client.delete(f"{NAME}/tags/ctd.sample_period_s/set").raise_for_status()
        until(lambda: tag(observatory, "ctd.sample_period_s")["value"] != 7, "the device has its own value again")


def test_requests_are_linked_with_their_replies(observatory: Studio) -> None:
    with observatory.client(VIEW) as client:
        params = {"device": "ctd", "service": "read holding registers"}
        rows = until(
            lambda: [r for r in client.get(f"{NAME}/frames", params=params).json()["rows"] if r["reply"] is not None],
            "an answered request",
        )
        request = rows[-1]
        detail = client.get(f"{NAME}/frames/{request['number']}").json()
        [reply] = detail["linked"]
        assert reply["request"] == request["number"]
        assert reply["latency_ns"] == reply["t_ns"] - request["t_ns"]
        assert request["bytes"].startswith("0103")


def test_frames_are_exported_as_packets_and_candump(observatory: Studio, tmp_path: Path) -> None:
    with observatory.client(VIEW) as client:
        until(lambda: client.get(f"{NAME}/frames", params={"bus": "can0"}).json()["total"], "CAN frames")
        packets = client.get(f"{NAME}/frames/export", params={"bus": "lan", "format": "pcap"})
        assert packets.content[:4] == MAGIC_NS.to_bytes(4, "big")
        every_bus = client.get(f"{NAME}/frames/export", params={"format": "pcapng"})
        (tmp_path / "frames.pcapng").write_bytes(every_bus.raise_for_status().content)
        with PacketFile(tmp_path / "frames.pcapng") as file:
            found = [(file.interface, t_ns) for t_ns, _, _ in file]
        assert {bus for bus, _ in found} == {"line1", "can0", "lan"}
        assert all(t_ns > EPOCH_UTC_NS for _, t_ns in found)
        text = client.get(f"{NAME}/frames/export", params={"bus": "can0", "format": "candump"}).text
        assert text.splitlines()[0].split()[1] == "can0"
        mixed = client.get(f"{NAME}/frames/export", params={"format": "pcap"})
        assert mixed.status_code == 400
        assert "one bus" in mixed.json()["error"]["message"]
        assert "can0" in mixed.json()["error"]["message"]


def test_a_selection_is_exported_as_a_recording_that_can_be_read(observatory: Studio, tmp_path: Path) -> None:
    with observatory.client(VIEW) as client:
        params = {"device": "ctd", "format": "recording"}
        until(lambda: len(latest(client, device="ctd")) > 10, "frames of the sensor")
        file = tmp_path / "ctd.jsonl"
        file.write_bytes(client.get(f"{NAME}/frames/export", params=params).raise_for_status().content)
        can = client.get(f"{NAME}/frames/export", params={"bus": "can0", "format": "recording"})
        assert can.status_code == 400
        assert "candump" in can.json()["error"]["message"]
        unknown = client.get(f"{NAME}/frames/export", params={"format": "xls"})
        assert "pcapng, pcap, candump, recording" in unknown.json()["error"]["message"]
    with RecordingReader(file) as recording:
        assert recording.header.prototype
        assert [e for e in recording.exchanges() if e.reply is not None]


def test_a_frame_has_its_fields_and_the_changes_of_tags_after_it(observatory: Studio) -> None:
    with observatory.client() as client:
        client.put(f"{NAME}/tags/ctd.sample_period_s/set", json={"value": 9}).raise_for_status()
        reply = until(
            lambda: next((r for r in latest(client, device="ctd") if r["tags"].get("sample_period_s") == 9), None),
            "the value is read",
        )
        assert reply
        path = f"{NAME}/frames/{reply['number']}"
        until(lambda: client.get(path).json()["effects"], "the change is recorded")
        shown = client.get(path).json()
        client.delete(f"{NAME}/tags/ctd.sample_period_s/set").raise_for_status()
    fields = {f["name"]: f for f in shown["fields"]}
    assert fields["sample_period_s"]["value"].startswith("9 s")
    assert sum(f["length"] for f in shown["fields"]) == len(shown["whole"] or shown["bytes"]) // 2
    [effect] = [e for e in shown["effects"] if e["tag"] == "ctd.sample_period_s"]
    assert (effect["value"], effect["quality"], effect["program"]) == (9, "good", "")
    assert effect["before"] != 9


def test_a_force_is_seen_recorded_and_removed(observatory: Studio) -> None:
    with observatory.client() as client:
        client.post(f"{NAME}/plc/forces", json={"tag": "ctd.sample_count", "value": 5}).raise_for_status()
        forces = client.get(f"{NAME}/plc").json()["forces"]
        assert forces["ctd.sample_count"]["value"] == 5
        assert forces["ctd.sample_count"]["by"].startswith("studio")
        client.delete(f"{NAME}/plc/forces").raise_for_status()
        assert client.get(f"{NAME}/plc").json()["forces"] == {}
    audit = (observatory.run_root / "observatory" / "audit.jsonl").read_text()
    assert '"force"' in audit
    assert '"unforce"' in audit
    assert "studio" in audit


def test_programs_are_described_with_the_names_of_their_states(observatory: Studio) -> None:
    with observatory.client(VIEW) as client:
        relay = until(lambda: client.get(f"{NAME}/plc/programs").json().get("relay"), "the programs are described")
    assert relay["machine"]["states"] == ["STANDBY", "ACTIVE", "OFF"]
    assert relay["variables"]["state"]["words"]["1"] == "ACTIVE"
    assert relay["source"]["file"] == "relay.py"


def test_a_transition_is_recorded_with_its_time_and_its_scan(observatory: Studio) -> None:
    def after(client: httpx.Client) -> list[Any]:
        changes: list[Any] = client.get(f"{NAME}/plc/transitions").json().get("relay", [])
        return changes

    with observatory.client() as client:
        until(lambda: after(client), "the first state is recorded")
        known = after(client)
        force = {"tag": "relay.state", "value": 2}
        client.post(f"{NAME}/plc/forces", json=force).raise_for_status()
        changed = until(lambda: (a := after(client))[-1]["after"] == 2 and a, "the transition is recorded")
        client.delete(f"{NAME}/plc/forces").raise_for_status()
        back = until(lambda: (a := after(client))[-1]["after"] != 2 and a, "the way back is recorded")
        now_ns = client.get(NAME).json()["now_ns"]
        newest = client.get(f"{NAME}/status").json()["transitions"]["relay"]
        why = client.get(f"{NAME}/plc/why/relay.state").json()
    assert changed[: len(known)] == known
    assert changed[len(known)]["forced"]
    assert [c["before"] for c in back[1:]] == [c["after"] for c in back[:-1]]
    assert [c["scan"] for c in back] == sorted({c["scan"] for c in back})
    assert known[-1]["t_ns"] < changed[-1]["t_ns"] < back[-1]["t_ns"] <= now_ns
    assert newest == back[-1]["t_ns"]
    explained_ns = why["now_ns"] - why["changes"][0]["age_ms"] * 1e6
    assert abs(explained_ns - newest) < 1e9, "both times of the transition are the same"


def test_the_status_has_buckets_of_cycle_times(observatory: Studio) -> None:
    with observatory.client(VIEW) as client:
        plc = client.get(f"{NAME}/plc").json()
    assert sum(count for _, count in plc["duration_buckets"]) == plc["duration_us"]["count"]


def test_changes_arrive_over_the_websocket(observatory: Studio) -> None:
    async def main() -> set[str]:
        url = f"{observatory.api}{NAME}/stream".replace("http", "ws", 1)
        async with websockets.connect(url, additional_headers={"Authorization": f"Bearer {VIEW}"}) as socket:
            hello = json.loads(await socket.recv())
            assert hello["type"] == "hello"
            assert hello["status"]["gateway"]["devices"]["ctd"]["bus"] == "line1"
            seen: set[str] = set()
            async with asyncio.timeout(30):
                while not {"status", "tags", "frames"} <= seen:
                    seen.add(json.loads(await socket.recv())["type"])
            return seen

    assert asyncio.run(main()) >= {"status", "tags", "frames"}


def test_two_browsers_see_the_same(observatory: Studio) -> None:
    async def main() -> list[Any]:
        url = f"{observatory.api}{NAME}/stream".replace("http", "ws", 1)
        headers = {"Authorization": f"Bearer {OPERATE}"}
        async with (
            websockets.connect(url, additional_headers=headers) as one,
            websockets.connect(url, additional_headers=headers) as other,
        ):
            seen = []
            for socket in (one, other):
                async with asyncio.timeout(30):
                    changes: list[Any] = []
                    while len(changes) < 30:
                        changes += json.loads(await socket.recv()).get("changes", [])
                    seen.append(changes)
            return seen

    first, second = asyncio.run(main())
    common = [change for change in first if change in second]
    assert common
    assert [c for c in second if c in common] == common


@pytest.mark.parametrize(
    ("method", "path", "body", "status", "text"),
    [
        ("GET", "/instances/nobody", None, 404, "no instance"),
        ("GET", f"{NAME}/tags/ctd.nothing/history", None, 404, "no tag"),
        ("GET", f"{NAME}/frames/999999999", None, 404, "no frame"),
        ("GET", f"{NAME}/frames?count=0", None, 400, "count"),
        ("GET", f"{NAME}/frames?count=x", None, 400, "whole number"),
        ("PUT", f"{NAME}/tags/ctd.status/set", '{"value": "x"}', 400, "Expected"),
        ("PUT", f"{NAME}/tags/ctd.status/set", "{", 400, "content"),
        ("PUT", f"{NAME}/tags/ctd.sample_period_s/set", '{"value": 1e300}', 400, "sample_period_s"),
        ("POST", f"{NAME}/faults", '{"fault": {"name": "silense"}}', 400, "silence"),
        ("POST", f"{NAME}/plc/forces", '{"tag": "no.tag", "value": 1}', 400, "no.tag"),
        ("POST", "/instances", '{"system": "/etc/passwd"}', 404, "no system"),
        ("DELETE", "/instances/other", None, 400, "has not started"),
        ("GET", "/nothing", None, 404, "nothing at"),
    ],
)
def test_bad_requests_are_refused_in_words(
    observatory: Studio, method: str, path: str, body: str | None, status: int, text: str
) -> None:
    with observatory.client() as client:
        answer = client.request(method, path, content=body)
    assert answer.status_code == status, answer.text
    assert text in answer.json()["error"]["message"]
    assert "Traceback" not in observatory.log.read_text()


def test_the_description_of_the_interface_names_every_operation(observatory: Studio) -> None:
    from fieldtwin.studio.app import OPERATIONS

    with observatory.client(VIEW) as client:
        told = client.get("/openapi.json").json()
    assert told["openapi"] == "3.1.0"
    assert sum(len(methods) for methods in told["paths"].values()) == len(OPERATIONS)
    force = told["paths"]["/api/v1/instances/{instance}/plc/forces"]["post"]
    assert force["requestBody"]["content"]["application/json"]["schema"]["$ref"] == "#/components/schemas/Force"
    assert set(told["components"]["schemas"]["Force"]["properties"]) == {"tag", "value"}


def test_a_client_is_sent_to_the_new_run_when_a_run_starts_under_the_same_name(observatory: Studio) -> None:
    folder = observatory.run_root / "again"
    folder.mkdir(mode=0o700)
    shutil.copy(observatory.run_root / "observatory" / SYSTEM_FILE, folder / SYSTEM_FILE)
    first = read_record(observatory.run_root / "observatory")
    assert first is not None
    write_record(folder, structs.replace(first, started_ns=1, capture=""))
    address = f"{observatory.url.replace('http', 'ws', 1)}api/v1/instances/again/stream"
    headers = {"Authorization": f"Bearer {VIEW}"}

    async def main() -> tuple[list[str], int]:
        async with websockets.connect(address, additional_headers=headers) as socket:
            assert json.loads(await socket.recv())["started_ns"] == 1
            write_record(folder, structs.replace(first, started_ns=2, capture=""))
            types = [json.loads(message)["type"] async for message in socket]  # until the server closes the connection
        async with websockets.connect(address, additional_headers=headers) as socket:
            return types, json.loads(await socket.recv())["started_ns"]

    try:
        types, started_ns = asyncio.run(asyncio.wait_for(main(), 30))
        assert types[-1] == "end"
        assert started_ns == 2
        with observatory.client(VIEW) as client:
            assert client.get("/instances/again").json()["started_ns"] == 2
    finally:
        shutil.rmtree(folder)


def test_a_fault_that_lasts_for_a_moment_has_marks_at_its_begin_and_end(observatory: Studio) -> None:
    with observatory.client() as client:
        before = len(client.get(f"{NAME}/marks").json())
        client.post(f"{NAME}/faults", json={"fault": {"name": "silence", "device": "ctd"}}).raise_for_status()
        client.delete(f"{NAME}/faults").raise_for_status()
        marks = [mark for mark in client.get(f"{NAME}/marks").json()[before:] if mark["kind"] != "state"]
    assert [(mark["kind"], mark["text"]) for mark in marks] == [
        ("fault", "silence on ctd"),
        ("cleared", "silence on ctd"),
    ]
    assert marks[0]["t_ns"] <= marks[1]["t_ns"]
