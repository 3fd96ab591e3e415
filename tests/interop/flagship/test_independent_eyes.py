"""tshark decodes the captures without malformed frames or wrong checksums, and its function codes and COB-IDs match our
counts."""

from __future__ import annotations

import os
import subprocess
import sys
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import pytest
from held import Held
from tshark import dissect, needs_tshark

from fieldtwin.capture.formats.pcap import read_capture
from fieldtwin.gateway.connections.tap import Captured
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.endpoint import Endpoint

pytestmark = [pytest.mark.interop, pytest.mark.timeout(120), needs_tshark]


@pytest.fixture(params=["with_emulators", "with_strangers"])
def held(request: pytest.FixtureRequest) -> Held:
    """Both conversations of the flagship test."""
    found: Held = request.getfixturevalue(request.param)
    return found


def test_tshark_decodes_the_modbus_tcp_capture(held: Held, tmp_path: Path) -> None:
    endpoint = held.run.system.buses["lan"].endpoint
    fields = ["ip.checksum.status", "tcp.checksum.status", "mbtcp.trans_id", "mbtcp.unit_id", "modbus.func_code"]
    fields += ["modbus.exception_code", "tcp.dstport"]
    packets = dissect(tmp_path / "lan.pcap", held.run.captured, endpoint, fields)
    assert {(p["ip.checksum.status"], p["tcp.checksum.status"]) for p in packets} == {("1", "1")}
    modbus = [p for p in packets if p["mbtcp.trans_id"]]
    assert len(modbus) == len(packets) - 3  # the handshake
    assert {p["_ws.col.Protocol"] for p in modbus} == {"Modbus/TCP"}
    assert {p["mbtcp.unit_id"] for p in modbus} == {"1"}
    requests = [p for p in modbus if p["tcp.dstport"] == "502"]
    assert len(requests) == held.run.requests["lan"] == len(held.talks["modem"].exchanges)
    assert len(modbus) == 2 * len(requests)
    assert Counter(p["modbus.func_code"] for p in requests) == functions(held, "modem")
    assert [p["modbus.exception_code"] for p in modbus if p["modbus.exception_code"]] == ["1", "2", "2"]


def test_tshark_decodes_the_modbus_rtu_capture(held: Held, tmp_path: Path) -> None:
    endpoint = held.run.system.buses["line1"].endpoint
    fields = ["mbrtu.unit_id", "mbrtu.crc16.status", "modbus.func_code", "modbus.exception_code", "_ws.col.Info"]
    packets = dissect(tmp_path / "line1.pcap", held.run.captured, endpoint, fields)
    assert {(p["mbrtu.unit_id"], p["mbrtu.crc16.status"], p["_ws.col.Protocol"]) for p in packets} == {
        ("1", "1", "Modbus RTU")
    }
    requests = packets[::2]
    assert len(packets) == 2 * len(requests)
    assert len(requests) == held.run.requests["line1"] == len(held.talks["ctd"].exchanges)
    assert Counter(p["modbus.func_code"] for p in requests) == functions(held, "ctd")
    assert [p["modbus.exception_code"] for p in packets if p["modbus.exception_code"]] == ["2", "3", "1", "2"]


def test_tshark_decodes_the_canopen_capture(held: Held, tmp_path: Path) -> None:
    endpoint = held.run.system.buses["can0"].endpoint
    fields = ["canopen.cob_id", "canopen.function_code", "canopen.sdo.abort_code", "canopen.nmt_ctrl.cd"]
    packets = dissect(tmp_path / "can0.pcap", held.run.captured, endpoint, [*fields, "canopen.nmt_guard.state"])
    assert {p["_ws.col.Protocol"] for p in packets} == {"CANopen"}
    frames = [c.item for c in held.run.of_bus("can0") if isinstance(c.item, CanFrame)]
    cob_ids = Counter(int(p["canopen.cob_id"], 16) for p in packets)
    assert cob_ids == Counter(f.can_id for f in frames)
    assert set(cob_ids) == {0x000, 0x185, 0x585, 0x605, 0x705}
    assert cob_ids[0x605] == cob_ids[0x585] == held.run.requests["can0"]
    assert [int(p["canopen.nmt_ctrl.cd"], 0) for p in packets if p["canopen.nmt_ctrl.cd"]] == [0x01, 0x80]
    aborts = [int(p["canopen.sdo.abort_code"], 16) for p in packets if p["canopen.sdo.abort_code"]]
    assert aborts == [0x06020000, 0x06090011, 0x06010002]
    states = [int(p["canopen.nmt_guard.state"], 16) for p in packets if p["canopen.nmt_guard.state"]]
    assert (states[0], states[-1], set(states)) == (0x7F, 0x7F, {0x7F, 0x05})


def functions(held: Held, device: str) -> Counter[str]:
    """Return how often each function code was sent, as tshark writes it."""
    return Counter(str(e.request[1]) for e in held.talks[device].exchanges)


@pytest.mark.parametrize("bus", ["line1", "lan"])
def test_tshark_would_see_a_broken_frame(bus: str, with_emulators: Held, tmp_path: Path) -> None:
    """tshark reports a byte changed in one reply, so its silence elsewhere is meaningful."""
    endpoint = with_emulators.run.system.buses[bus].endpoint
    captured = [c for c in with_emulators.run.captured if c.endpoint == endpoint]
    path, fields = tmp_path / "broken.pcap", ["mbrtu.crc16.status", "mbtcp.trans_id"]
    if bus == "line1":  # a byte of the data, so that the CRC is wrong
        with pytest.raises(AssertionError, match="packet 2"):
            dissect(path, changed(captured, endpoint, 3), endpoint, fields)
    else:  # the protocol id of the MBAP header: not Modbus at all
        packets = dissect(path, changed(captured, endpoint, 3), endpoint, fields)
        assert [i for i, p in enumerate(packets, 1) if not p["mbtcp.trans_id"]] == [1, 2, 3, 5]


def changed(captured: list[Captured], endpoint: Endpoint, spot: int) -> list[Captured]:
    """Return the capture with one byte of the second chunk, the first reply, changed."""
    reply = captured[1]
    assert isinstance(reply.item, bytes)
    item = reply.item[:spot] + bytes([reply.item[spot] ^ 1]) + reply.item[spot + 1 :]
    return [captured[0], Captured(reply.t_ns, endpoint, reply.direction, item), *captured[2:]]


def test_the_content_of_a_capture(short_dir: Callable[[], Path], tmp_path: Path) -> None:
    """``fieldtwin run --capture FILE`` from the command line: tshark can read every wire in the file."""
    capture = tmp_path / "capture.jsonl"
    command = [sys.executable, "-m", "fieldtwin", "run", "observatory", "--prototype", "--for", "3s"]
    ran = subprocess.run(
        [*command, "--commands", "1", "--capture", str(capture)],
        capture_output=True,
        text=True,
        timeout=60,
        env={**os.environ, "FIELDTWIN_RUN": str(short_dir())},
    )
    assert ran.returncode == 0, ran.stdout + ran.stderr
    captured = list(read_capture(capture))
    endpoints = list(dict.fromkeys(c.endpoint for c in captured))
    assert sorted(e.scheme for e in endpoints) == ["can", "rtu", "tcp"]
    names = {"can": "CANopen", "rtu": "Modbus RTU", "tcp": "Modbus/TCP"}
    for endpoint in endpoints:
        packets = dissect(tmp_path / f"{endpoint.scheme}.pcap", captured, endpoint, ["mbrtu.crc16.status"])
        assert {p["_ws.col.Protocol"] for p in packets} - {"TCP"} == {names[endpoint.scheme]}
        assert {p["mbrtu.crc16.status"] for p in packets} <= {"", "1"}
