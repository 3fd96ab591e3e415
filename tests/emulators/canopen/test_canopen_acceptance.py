"""The emulated node's acceptance filter: a frame that it rejects could have had no effect, and it follows the dictionary."""

from __future__ import annotations

from canopen_slave_rig import NODE, RICH
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldtwin.emulators.canopen.eds.dictionary import parse_eds
from fieldtwin.emulators.canopen.node import CanopenNode
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.connection import CANConnection, CanConnection
from fieldtwin.gateway.core.endpoint import Endpoint

EDS = parse_eds(RICH)


def started() -> CanopenNode:
    node = CanopenNode(EDS, NODE)
    node.start(0)
    node.feed(CanFrame(0, bytes([1, NODE])), 0)
    return node


def sdo(node: CanopenNode, text: str) -> None:
    node.feed(CanFrame(0x600 + NODE, bytes.fromhex(text)), 1)


@settings(max_examples=150)
@given(st.integers(0, 0x7FF), st.binary(max_size=8), st.booleans())
def test_a_rejected_frame_would_have_had_no_effect(can_id: int, data: bytes, remote: bool) -> None:
    node, untouched = started(), started()
    frame = CanFrame(can_id, b"" if remote else data, remote=remote, dlc=len(data))
    if node.accepts(frame):
        return
    assert node.feed(frame, 5) == []
    assert node.wake_at_ns() == untouched.wake_at_ns()
    assert list(node.changes) == list(untouched.changes)
    assert node.state is untouched.state


def test_frames_that_the_filter_accepts() -> None:
    node = started()
    let_in = {i for i in range(0x800) if node.accepts(CanFrame(i, b""))}
    assert let_in >= {0x000, 0x080, 0x085, 0x185, 0x205, 0x285, 0x305, 0x585, 0x605, 0x705, 0x7E5}
    assert len(let_in) < 20
    assert node.accepts(CanFrame(0x12345, b"", extended=True))


def test_the_filter_follows_writes_of_a_client_and_resets() -> None:
    node = started()
    moved, watched = CanFrame(0x3A0, bytes(3)), CanFrame(0x722, b"\x05")
    assert not node.accepts(moved)
    assert not node.accepts(watched)
    sdo(node, "23001401a0030080")
    sdo(node, "23001401a0030000")
    sdo(node, "2316100164002200")  # heartbeat of node 34, 100 ms
    assert node.accepts(moved)
    assert node.accepts(watched)
    node.feed(CanFrame(0, bytes([130, NODE])), 2)
    assert not node.accepts(moved)
    assert not node.accepts(watched)


def test_a_connection_with_a_filter_counts_no_overrun_for_rejected_frames() -> None:
    class End(CanConnection):
        async def send(self, frame: CanFrame) -> None:
            raise AssertionError("nobody sends here")

        async def aclose(self) -> None:
            raise AssertionError("nobody closes this")

    end = End(CANConnection(), Endpoint.parse("can:fieldtwin/127.0.0.1:1"), max_pending=3)
    end.accept = lambda frame: frame.can_id < 0x100
    for can_id in (0x080, 0x181, 0x182, 0x000):
        assert end.feed(CanFrame(can_id, b""))
    assert [frame.can_id for frame in end.inbound.data_stream] == [0x080, 0x000]
    assert end.overruns == 0
