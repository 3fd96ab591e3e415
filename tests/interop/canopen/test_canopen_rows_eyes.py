"""All frames that the emulated node sends in the rows of the test-case lists, as tshark's CANopen dissector decodes them."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest
from tshark import dissect, needs_tshark

from fieldtwin.gateway.connections.tap import Captured
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.connection import Direction
from fieldtwin.gateway.core.endpoint import Endpoint

pytestmark = [pytest.mark.interop, needs_tshark]
ROWS = tomllib.loads((Path(__file__).parents[2] / "vectors" / "canopen_slave.toml").read_text(encoding="utf-8"))["row"]
SDO_REPLIES = range(0x581, 0x600)
FIELDS = {
    "canopen.sdo.abort_code": lambda f: f.can_id in SDO_REPLIES and f.data[0] == 0x80,
    "canopen.em.err_code": lambda f: f.can_id in range(0x81, 0x100) and f.data,
    "canopen.nmt_guard.state": lambda f: f.can_id in range(0x701, 0x780),
}
"""By tshark's name: which of the frames carry it, according to CiA 301."""


def test_all_frames_of_the_node_are_valid_canopen(tmp_path: Path) -> None:
    endpoint = Endpoint.parse("can:fieldtwin/127.0.0.1:1")
    frames = [
        CanFrame(int(can_id, 16), bytes.fromhex(data))
        for row in ROWS
        for _, said in row["say"]
        for can_id, _, data in [said.partition("#")]
        if not data.startswith("R")
    ]
    captured = [Captured((i + 1) * 10**6, endpoint, Direction.RECEIVED, frame) for i, frame in enumerate(frames)]
    packets = dissect(tmp_path / "rows.pcap", captured, endpoint, [*FIELDS, "canopen.cob_id"])
    assert len(frames) > 400
    for frame, packet in zip(frames, packets, strict=True):
        assert int(packet["canopen.cob_id"], 0) == frame.can_id
        for name, carries in FIELDS.items():
            shown = packet[name]
            if not carries(frame):  # without its context, a segment of a block looks like any command
                assert not shown or frame.can_id in SDO_REPLIES, (str(frame), packet)
                continue
            if name.endswith("abort_code"):
                assert int(shown, 0) == int.from_bytes(frame.data[4:8], "little")
            elif name.endswith("err_code"):
                assert int(shown, 0) == int.from_bytes(frame.data[:2], "little")
            else:
                assert int(shown, 0) == frame.data[0] & 0x7F
