"""Each case for CANopen nodes can fail: a node with one error fails the case for that error."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from canopen_slave_rig import NODE
from nodes_on_a_bus import LONG, on_bus

from fieldtwin.conformance.core.case import CasePlan, Impact
from fieldtwin.conformance.devices.canopen.session import CanopenOptions, check_canopen
from fieldtwin.emulators.canopen.eds.dictionary import parse_eds
from fieldtwin.emulators.canopen.node import CanopenNode
from fieldtwin.emulators.canopen.serve import serve_node
from fieldtwin.emulators.endpoints.memory_ports import MemoryNet
from fieldtwin.emulators.virtual.clock import VirtualClock
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.connection import CanConnection
from fieldtwin.results.model import Verdict

Twist = Callable[[CanFrame, list[CanFrame]], list[CanFrame]]
"""Map a received frame and the correct reply to the frames sent."""
MAY_WRITE = ((0x2000, 0), (0x2004, 0), (0x1017, 0))
SDO, REPLY = 0x600 + NODE, 0x580 + NODE


class TwistedNode(CanopenNode):
    """The node of the tests, with one error."""

    twist: Twist
    deaf: bytes = b"\xff"
    """Do not execute requests that begin with these bytes, whatever the reply is."""

    def accepts(self, frame: CanFrame) -> bool:
        return True

    def feed(self, frame: CanFrame, now_ns: int) -> list[CanFrame]:
        right = [] if frame.extended or frame.data.startswith(self.deaf) else super().feed(frame, now_ns)
        return self.twist(frame, right)


def reply(text: str) -> CanFrame:
    return CanFrame(REPLY, bytes.fromhex(text).ljust(8, b"\0"))


def instead(heard: str, said: str) -> Twist:
    """Reply `said` ('' for silence) to SDO requests that begin with `heard`."""

    def twist(frame: CanFrame, right: list[CanFrame]) -> list[CanFrame]:
        asked = frame.can_id == SDO and not frame.extended and frame.data.startswith(bytes.fromhex(heard))
        return ([reply(said)] if said else []) if asked else right

    return twist


def other_abort(code: int, said: str) -> Twist:
    """Reply `said` instead of an abort with that code."""
    ending = code.to_bytes(4, "little")

    def twist(frame: CanFrame, right: list[CanFrame]) -> list[CanFrame]:
        return [
            reply(said) if f.can_id == REPLY and f.data[:1] == b"\x80" and f.data[4:] == ending else f for f in right
        ]

    return twist


def after(heard: str, change: Twist) -> Twist:
    """`change` the reply that follows directly after a request that begins with `heard`."""
    armed = [False]

    def twist(frame: CanFrame, right: list[CanFrame]) -> list[CanFrame]:
        was, armed[0] = armed[0], frame.can_id == SDO and frame.data.startswith(bytes.fromhex(heard))
        return change(frame, right) if was else right

    return twist


def says_besides(frame: CanFrame, right: list[CanFrame]) -> list[CanFrame]:
    """Acknowledge a sub-block twice."""
    return [*right, *(f for f in right if f.can_id == REPLY and f.data[0] == 0xA2)]


def acknowledges_all(frame: CanFrame, right: list[CanFrame]) -> list[CanFrame]:
    """Treat a lost segment as received."""
    return [reply("A2 03 7F") if f.can_id == REPLY and f.data[:2] == b"\xa2\x01" else f for f in right]


def loses_the_first(frame: CanFrame, right: list[CanFrame]) -> list[CanFrame]:
    """Start the repetition with the second segment."""
    return right[1:] if frame.data[:2] == b"\xa2\x02" else right


def answers_extended(frame: CanFrame, right: list[CanFrame]) -> list[CanFrame]:
    return [reply("43 00 10 00 00 00 00 00")] if frame.extended and frame.can_id == SDO else right


def resets_on_one_byte(frame: CanFrame, right: list[CanFrame]) -> list[CanFrame]:
    return [CanFrame(0x700 + NODE, b"\0")] if frame.can_id == 0 and len(frame.data) == 1 else right


def sends_pdos_early(frame: CanFrame, right: list[CanFrame]) -> list[CanFrame]:
    return [*right, CanFrame(0x180 + NODE, b"\1")] if frame.can_id == 0 and frame.data[:1] == b"\x80" else right


def stays_silent_when_reset(frame: CanFrame, right: list[CanFrame]) -> list[CanFrame]:
    return [f for f in right if f.can_id != 0x700 + NODE or f.data != b"\0"]


TWISTS: dict[str, Twist] = {
    "CO-001a": other_abort(0x0503_0000, "80 08 10 00 00 00 00 08"),
    "CO-002": after("80", lambda frame, right: [reply("00 61")] if frame.data[0] == 0x70 else right),
    "CO-003a": after("40 00 10 00", lambda frame, right: [] if frame.data[:1] == b"\x60" else right),
    "CO-004": instead("E0", ""),
    "CO-005": after("60", lambda frame, right: [reply("43 08 10 00")] if frame.data[0] == 0x40 else right),
    "CO-006a": instead("23 00 10 00", "60 00 10 00"),
    "CO-006b": instead("21 00 10 00 14", "60 00 10 00"),
    "CO-007": other_abort(0x0601_0001, "80 03 20 00 00 00 01 06"),
    "CO-008a": instead("40 FE 5F", "80 FE 5F 00 00 00 00 08"),
    "CO-008b": instead("40 00 10 01", "43 00 10 01"),
    "CO-008c": instead("40 18 10 05", "43 18 10 05"),
    "CO-009a": instead("21 00 20 00 03", "60 00 20 00"),
    "CO-009b": instead("2F 00 20 00", "60 00 20 00"),
    "CO-010a": other_abort(0x0609_0031, "60 00 20 00"),
    "CO-010b": other_abort(0x0609_0032, "80 00 20 00 31 00 09 06"),
    "CO-011": instead("2F 03 10 00", "60 03 10 00"),
    "CO-012": instead("40 03 10 01", "43 03 10 01"),
    "CO-013a": instead("09", "20"),
    "CO-013b": instead("0D", "80 00 20 00 12 00 07 06"),
    "CO-014a": instead("A4 08 10 00 00", "C6 08 10 00 10"),
    "CO-014b": instead("A4 08 10 00 80", "80 08 10 00 00 00 00 08"),
    "CO-015": other_abort(0x0504_0004, "A1"),
    "CO-016": loses_the_first,
    "CO-017": acknowledges_all,
    "CO-019": after("A1", lambda frame, right: []),
    "CO-020": says_besides,
    "CO-021": instead("A4 08 10 00 7F 00", "41 08 10 00 10"),
    "CO-029": instead("22 00 20", "80 00 20 00 10 00 07 06"),
    "CO-031": instead("23 10 10 01", "60 10 10 01"),
    "CO-032a": stays_silent_when_reset,
    "CO-033": resets_on_one_byte,
    "CO-041": instead("2B 17 10 00 C8", "60 17 10 00"),
    "CO-044": sends_pdos_early,
    "CO-060": answers_extended,
}
ALONG = {
    "CO-001a": {"CO-001b"}, "CO-005": {"CO-003a", "CO-027"}, "CO-017": {"CO-015"}, "CO-019": {"CO-016"},
    "CO-020": {"CO-015", "CO-017"}, "CO-032a": {"CO-027", "CO-032b"},
}  # fmt: skip
"""Cases that fail as well, because they test the same property."""


@pytest.mark.parametrize("case_id", TWISTS)
def test_a_wrong_node_fails_the_case_for_its_error(case_id: str, tmp_path: Path) -> None:
    eds = tmp_path / "rig.eds"
    eds.write_text(LONG)

    async def serve(connection: CanConnection, clock: VirtualClock) -> None:
        node = TwistedNode(parse_eds(LONG), NODE)
        node.twist = TWISTS[case_id]
        node.deaf = b"\x2b\x17\x10" if case_id == "CO-041" else node.deaf
        await serve_node(connection, node, clock)

    async def use(net: MemoryNet, url: str, clock: VirtualClock) -> dict[str, str]:
        plan = CasePlan(at_most=Impact.DISRUPT, has=frozenset({"object", "eds", "i-know"}))
        options = CanopenOptions(
            url, NODE, plan, eds=eds, may_write=MAY_WRITE, connector=net, clock=clock, timeout_s=0.1, boot_s=0.5
        )  # fmt: skip
        results = (await check_canopen(options)).results
        return {r.case.id: r.reason for r in results if r.verdict is Verdict.FAILED}

    found = on_bus(serve, use)
    assert case_id in found, found
    assert set(found) - {case_id} <= ALONG.get(case_id, set()), found
