"""The wire log of a test shows every frame that the driver received, and refuses an expectation that can never be met.

Defects, with pymodbus, minimalmodbus, modbus_tk and canopen as drivers under test: a reply with a wrong unit ID was not in the
log at all, nor was an SDO reply without a request. An expectation that counts zero times passed if the field, the problem or
the access that it named did not exist.
"""

from __future__ import annotations

import socket
import struct
from collections.abc import Iterator

import pytest

from fieldtwin.capture.decoding.canopen_bus import CanopenBusDecoder
from fieldtwin.capture.decoding.exchange import DecodedExchange
from fieldtwin.capture.decoding.modbus_connection import ModbusConnectionDecoder
from fieldtwin.emulators.modbus.rtu.receiver import with_crc
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.testing.handles import DeviceHandle
from fieldtwin.testing.runner import WorkerProcess

READ = struct.pack(">BHH", 4, 0, 2)
PATIENCE_S = 30.0


@pytest.fixture(scope="module")
def runner() -> Iterator[WorkerProcess]:
    runner = WorkerProcess()
    runner.call("hello")  # its threads begin before those of the first test are counted
    yield runner
    runner.close()


@pytest.fixture
def device(runner: WorkerProcess) -> Iterator[DeviceHandle]:
    answer = runner.call("device", device="eastron-sdm630", on="tcp", values={"voltage_l1": 230.5})
    yield DeviceHandle(runner, answer["id"], "device", answer)
    runner.call("end", id=answer["id"])


def _ask(device: DeviceHandle) -> bytes:
    with socket.create_connection((device.host, device.port), PATIENCE_S) as link:
        link.sendall(struct.pack(">HHHB", 1, 0, len(READ) + 1, device.unit) + READ)
        return link.recv(100)


def test_a_reply_with_a_wrong_unit_id_is_a_stray_of_the_device(device: DeviceHandle) -> None:
    with device.fault("wrong-unit", unit_id=99):
        got = _ask(device)
    assert got[6] == 99
    (stray,) = device.wire.expect(problem="stray", within_s=PATIENCE_S)
    assert (stray.unit, stray.transaction) == (99, 1)
    assert "device: a reply without a request: transaction 1, unit 99" in stray.text
    assert device.wire.count() == 1


def test_the_text_of_a_stray_explains_why_its_bytes_are_hidden(device: DeviceHandle) -> None:
    with device.fault("wrong-unit", unit_id=99):
        _ask(device)
    (stray,) = device.wire.expect(problem="stray", within_s=PATIENCE_S)
    assert "(secret): the device has secret tags" in stray.text
    assert stray.reply == b""


@pytest.mark.parametrize(
    ("like", "says"),
    [
        ({"func": 4}, "an exchange has no 'func'; did you mean 'function'?"),
        ({"problem": "timeout"}, "no exchange has the problem 'timeout'; expected one of '', 'pending', 'no reply'"),
        ({"access": "writes"}, "no exchange has the access 'writes'; expected one of '', 'read', 'write'"),
    ],
)
def test_a_selection_that_no_exchange_can_match_is_refused(
    device: DeviceHandle, like: dict[str, object], says: str
) -> None:
    with pytest.raises(TypeError) as refused:
        device.wire.expect(times=0, within_s=0.0, **like)
    assert says in str(refused.value)
    with pytest.raises(TypeError):
        device.wire.count(**like)


def test_bounds_that_no_number_meets_are_refused(device: DeviceHandle) -> None:
    with pytest.raises(TypeError, match="at least 3 and at most 2 can never be met"):
        device.wire.expect(at_least=3, at_most=2, within_s=0.0)


def _answers(*replies: str) -> list[tuple[str, str]]:
    """Return problem and reply of each exchange if one RTU request for two registers is answered by `replies`, in hex."""
    wire = ModbusConnectionDecoder("line1", "rtu", {})
    wire.feed(True, with_crc(bytes((1,)) + READ), 0)
    done = [e for n, reply in enumerate(replies) for e in wire.feed(False, bytes.fromhex(reply), n)[1]]
    return [(e.problem, e.reply_text) for e in [*done, *wire.pending()]]


def test_an_rtu_reply_with_another_byte_count_and_a_right_check_sum_is_malformed_at_once() -> None:
    """Defect: pymodbus accepted the short reply, and the log reported no reply; for the long one it reported a wrong checksum."""
    short = with_crc(bytes.fromhex("010402 4366")).hex()
    long = with_crc(bytes.fromhex("010406 436680000000")).hex()
    assert (
        _answers(short) == _answers(short[:4], short[4:]) == [("malformed", "4 bytes that do not answer the request")]
    )
    assert _answers(long) == [("malformed", "8 bytes that do not answer the request")]


def test_a_whole_reply_and_a_part_of_one_are_unchanged() -> None:
    good = with_crc(bytes.fromhex("010404 43668000")).hex()
    assert [problem for problem, _ in _answers(good)] == [""]
    assert [problem for problem, _ in _answers(good[:14])] == ["pending"]
    assert [problem for problem, _ in _answers(good[:-2] + "00")] == ["check sum"]


REQUEST = CanFrame(0x605, bytes.fromhex("4000100000000000"))
REPLY = CanFrame(0x585, bytes.fromhex("4300100091010000"))
OTHER = CanFrame(0x585, bytes.fromhex("4301100091010000"))
ABORT = CanFrame(0x605, bytes.fromhex("8000100000000405"))


def _decode(*frames: CanFrame) -> list[DecodedExchange]:
    wire = CanopenBusDecoder("can0", [])
    found = [e for n, frame in enumerate(frames) for e in wire.feed(frame, n * 1_000_000)[1]]
    return found + wire.finish()


@pytest.mark.parametrize(
    ("frames", "problems", "says"),
    [
        ((REQUEST, REPLY, REPLY), ["", "stray"], "an SDO reply without a request: 43 00 10 00 91 01 00 00"),
        ((REQUEST, ABORT, REPLY), ["abort", "stray"], "an SDO reply without a request"),
        ((REQUEST, OTHER), ["stray", "no reply"], "an SDO reply to another request: 43 01 10 00 91 01 00 00"),
        ((REQUEST, CanFrame(0x585, b"\x43")), ["stray", "no reply"], "an SDO reply of 1 byte: 43"),
        ((CanFrame(0x585, bytes.fromhex("8000100000000206")),), ["stray"], "abort 06020000h"),
    ],
)
def test_an_sdo_reply_that_answers_no_request_is_a_stray(
    frames: tuple[CanFrame, ...], problems: list[str], says: str
) -> None:
    found = _decode(*frames)
    assert [e.problem for e in found] == problems
    (stray,) = (e for e in found if e.is_stray)
    assert says in stray.text
    assert (stray.unit, stray.reply) == (5, frames[-1].data)
