"""The fields of frames: values from the standards' examples and the profiles; any bytes are covered exactly once."""

from __future__ import annotations

from collections.abc import Sequence

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldtwin.capture.decoding.canopen_fields import canopen_fields
from fieldtwin.capture.decoding.fields import FieldSpan
from fieldtwin.capture.decoding.modbus_fields import modbus_fields
from fieldtwin.capture.decoding.node_map import NodeMap
from fieldtwin.capture.decoding.tags import TagMap
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.protocols.modbus.frames.crc import with_crc
from fieldtwin.twin.site.system import load_system

SYSTEM = load_system("observatory")
UNITS = {d.address: TagMap(d.profile) for d in SYSTEM.devices.values() if d.profile.protocol == "modbus"}
NODES = {d.address: NodeMap(d) for d in SYSTEM.devices.values() if d.profile.protocol == "canopen"}
CTD = SYSTEM.devices["ctd"]


def assert_covered(spans: Sequence[FieldSpan], size: int) -> None:
    covered = [n for s in spans for n in range(s.offset, s.offset + s.length)]
    assert covered == list(range(size))


def said(spans: Sequence[FieldSpan]) -> dict[str, str]:
    return {s.name: s.value for s in spans}


@pytest.mark.parametrize("framing", ["rtu", "ascii", "mbap", "udp"])
@given(is_request=st.booleans(), data=st.binary(max_size=300), request=st.binary(max_size=40))
def test_any_modbus_bytes_are_covered_exactly_once(framing: str, is_request: bool, data: bytes, request: bytes) -> None:
    assert_covered(modbus_fields(framing, is_request, data, request, UNITS), len(data))


functions = st.one_of(
    st.sampled_from([1, 2, 3, 4, 5, 6, 7, 8, 11, 15, 16, 20, 21, 22, 23, 24, 43]), st.integers(0, 255)
)
units = st.sampled_from([*UNITS, 0, 247])


@pytest.mark.parametrize("framing", ["rtu", "ascii", "mbap"])
@given(
    is_request=st.booleans(),
    unit=units,
    function=functions,
    rest=st.binary(max_size=250),
    asked=st.binary(min_size=4, max_size=4),
)
def test_frames_with_a_valid_envelope_and_any_content_are_covered_exactly_once(
    framing: str, is_request: bool, unit: int, function: int, rest: bytes, asked: bytes
) -> None:
    data = enveloped(framing, bytes([unit, function]) + rest)
    request = enveloped(framing, bytes([unit, function & 0x7F]) + asked)
    assert_covered(modbus_fields(framing, is_request, data, request, UNITS), len(data))


def enveloped(framing: str, body: bytes) -> bytes:
    if framing == "rtu":
        return with_crc(body)
    if framing == "ascii":
        return b":" + (body + bytes([-sum(body) & 0xFF])).hex().upper().encode() + b"\r\n"
    return b"\0\1\0\0" + len(body).to_bytes(2) + body


@given(
    can_id=st.one_of(
        st.integers(0, 0x7FF), st.sampled_from([b + n for b in (0x80, 0x180, 0x580, 0x600, 0x700) for n in NODES])
    ),
    data=st.binary(max_size=8),
)
def test_any_can_frame_is_covered_exactly_once(can_id: int, data: bytes) -> None:
    spans = canopen_fields(CanFrame(can_id, data), NODES)
    assert_covered(spans, len(data))
    assert spans[0].name == "COB-ID"


def test_a_read_request_has_both_notations_of_its_address_and_a_right_check_sum() -> None:
    spans = modbus_fields("rtu", True, bytes.fromhex("010300010001d5ca"))
    assert [(s.offset, s.length, s.name, s.value) for s in spans] == [
        (0, 1, "unit ID", "1"),
        (1, 1, "function", "03h read holding registers"),
        (2, 2, "address", "40002 (holding:1)"),
        (4, 2, "count", "1"),
        (6, 2, "CRC", "right"),
    ]
    assert all("SL" in s.note or "AP" in s.note for s in spans)


def test_a_wrong_check_sum_is_named_with_the_right_one() -> None:
    assert said(modbus_fields("rtu", True, bytes.fromhex("010300010001d5cb")))["CRC"] == "wrong: these bytes have d5 ca"


def test_a_reply_has_the_values_of_the_tags_that_lie_at_its_registers() -> None:
    request, reply = bytes.fromhex("010300010001d5ca"), bytes.fromhex("01030200057847")
    unit = {1: TagMap(CTD.profile)}
    spans = modbus_fields("rtu", False, reply, request, unit)
    [value] = [s for s in spans if s.name == "sample_period_s"]
    assert (value.offset, value.length, value.value) == (3, 2, "5 s (0005h)")
    assert "40002 (holding:1)" in value.note
    alone = modbus_fields("rtu", False, reply, b"", unit)
    assert said(alone)["register"] == "5 (0005h)"


def test_an_exception_has_its_name() -> None:
    spans = modbus_fields("mbap", False, bytes.fromhex("000700000003018302"))
    assert said(spans)["exception code"] == "02 illegal data address"
    assert said(spans)["function"] == "83h: refusal of 03h read holding registers"
    assert said(spans)["transaction ID"] == "7"


def test_fields_of_ascii_count_characters() -> None:
    data = enveloped("ascii", bytes.fromhex("010300010001"))
    spans = modbus_fields("ascii", True, data)
    assert [(s.offset, s.length) for s in spans] == [(0, 1), (1, 2), (3, 2), (5, 4), (9, 4), (13, 2), (15, 2)]
    assert said(spans)["LRC"] == "right"


def test_an_sdo_request_names_its_object_and_an_abort_its_reason() -> None:
    node, known = next(iter(NODES.items()))
    read = said(canopen_fields(CanFrame(0x600 + node, bytes.fromhex("4000100000000000")), NODES))
    assert read["COB-ID"].endswith(f"{known.name} (node {node})")
    assert read["command"] == "40h upload (read)"
    assert read["index"] == "1000h Device type"
    abort = said(canopen_fields(CanFrame(0x580 + node, bytes.fromhex("8000100000000206")), NODES))
    assert abort["abort code"].startswith("06020000h")
    assert len(abort["abort code"]) > len("06020000h ")


def test_an_expedited_value_has_its_size_and_unused_bytes() -> None:
    spans = canopen_fields(CanFrame(0x585, bytes.fromhex("4f00200107000000")))
    assert said(spans)["command"] == "4Fh upload (read), expedited, 1 bytes"
    assert [(s.offset, s.length, s.name) for s in spans[-2:]] == [(4, 1, "data"), (5, 3, "unused")]


def test_nmt_heartbeat_emcy_and_sync_are_explained() -> None:
    assert said(canopen_fields(CanFrame(0, b"\x01\x00")))["command"] == "01h start"
    assert said(canopen_fields(CanFrame(0x705, b"\x05")))["state"] == "05h operational"
    emcy = said(canopen_fields(CanFrame(0x85, bytes.fromhex("3081110000000000"))))
    assert emcy["error code"] == "8130h life guard error or heartbeat error"
    assert emcy["error register"] == "11h generic, communication"
    assert said(canopen_fields(CanFrame(0x80, b"\x09")))["counter"] == "9"


def test_a_mapped_pdo_has_a_field_for_each_object() -> None:
    mapped = [(cob, pdo.mapping) for node in NODES.values() for cob, pdo in node.pdos.items() if pdo.mapping]
    assert mapped
    for cob, mapping in mapped:
        spans = canopen_fields(CanFrame(cob, bytes(mapping.length)), NODES)
        assert len(spans) > 1
        assert spans[1].name[4:6] == "h:"
        assert_covered(spans, mapping.length)
