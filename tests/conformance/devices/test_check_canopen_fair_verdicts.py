"""Unfair verdicts of `check canopen`: CO-005 failed a node that aborts, and cases were skipped with a wrong reason."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from canopen_slave_rig import NODE
from nodes_on_a_bus import LONG, on_bus, ours

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

SDO, REPLY = 0x600 + NODE, 0x580 + NODE
ABORT = bytes.fromhex("80 00 10 00 01 00 04 05")
LENGTH, VALUE = (code.to_bytes(4, "little") for code in (0x0607_0010, 0x0609_0030))
NEEDS_A_NUMBER = ("CO-009a", "CO-009b", "CO-013a", "CO-013b", "CO-015", "CO-029")
NEEDS_A_TEXT = ("CO-001b", "CO-017", "CO-020")
Serve = Callable[[CanConnection, VirtualClock], object]


class AbortingNode(CanopenNode):
    """A node that aborts an initiate during a transfer. Then it serves again, unless it `hangs`."""

    hangs = False
    _in_transfer = False
    _hung = False

    def accepts(self, frame: CanFrame) -> bool:
        return True

    def feed(self, frame: CanFrame, now_ns: int) -> list[CanFrame]:
        if frame.can_id != SDO or frame.extended:
            return super().feed(frame, now_ns)
        if self._in_transfer and frame.data[:1] == b"\x40":
            self._in_transfer = False
            self._hung = self.hangs
            super().feed(CanFrame(SDO, b"\x80" + frame.data[1:4] + bytes(4)), now_ns)
            return [CanFrame(REPLY, ABORT)]
        if self._hung and frame.data[:1] == b"\x40":
            return [CanFrame(REPLY, ABORT)]
        replies = super().feed(frame, now_ns)
        self._in_transfer = frame.data[0] & 0xE0 == 0x60 and not any(reply.data[0] & 0x81 for reply in replies)
        return replies


class GeneralCodesNode(CanopenNode):
    """A node that aborts with the general codes of CiA 301, and checks a length only when the data is complete."""

    _held_back = False

    def accepts(self, frame: CanFrame) -> bool:
        return True

    def feed(self, frame: CanFrame, now_ns: int) -> list[CanFrame]:
        if self._held_back and frame.can_id == SDO and not frame.extended:
            self._held_back = False
            return [CanFrame(REPLY, b"\x80\0\x20\0" + LENGTH)]
        replies = [general(reply) for reply in super().feed(frame, now_ns)]
        if frame.data[:1] == b"\x21" and replies and replies[0].data[4:] == LENGTH:
            self._held_back = True
            return [CanFrame(REPLY, b"\x60" + frame.data[1:4] + bytes(4))]
        return replies


def general(reply: CanFrame) -> CanFrame:
    """Return an abort with the general code that contains its specific one; other replies unchanged."""
    wider = {0x0607_0012: LENGTH, 0x0607_0013: LENGTH, 0x0609_0031: VALUE, 0x0609_0032: VALUE}
    code = int.from_bytes(reply.data[4:], "little") if reply.data[:1] == b"\x80" else 0
    return CanFrame(reply.can_id, reply.data[:4] + wider[code]) if code in wider else reply


async def general_codes(connection: CanConnection, clock: VirtualClock) -> None:
    await serve_node(connection, GeneralCodesNode(parse_eds(LONG), NODE), clock)


def aborting(*, hangs: bool) -> Callable[[CanConnection, VirtualClock], object]:
    async def serve(connection: CanConnection, clock: VirtualClock) -> None:
        node = AbortingNode(parse_eds(LONG), NODE)
        node.hangs = hangs
        await serve_node(connection, node, clock)

    return serve


def verdicts(
    serve: Serve, tmp_path: Path, *only: str, may_write: tuple[tuple[int, int], ...], sheet: str = LONG
) -> dict[str, tuple[Verdict, str]]:
    eds = tmp_path / "rig.eds"
    eds.write_text(sheet)

    async def use(net: MemoryNet, url: str, clock: VirtualClock) -> dict[str, tuple[Verdict, str]]:
        plan = CasePlan(frozenset(only), Impact.WRITE, frozenset({"object", "eds"}))
        options = CanopenOptions(
            url, NODE, plan, eds=eds, may_write=may_write, connector=net, clock=clock, timeout_s=0.1, boot_s=0.5
        )  # fmt: skip
        return {r.case.id: (r.verdict, r.reason) for r in (await check_canopen(options)).results}

    return on_bus(serve, use)  # type: ignore[arg-type]


def test_a_node_that_aborts_a_new_initiate_and_serves_the_next_one_passes(tmp_path: Path) -> None:
    found = verdicts(aborting(hangs=False), tmp_path, "CO-005", may_write=())
    verdict, reason = found["CO-005"]
    assert verdict is Verdict.PASSED, found
    assert "abort 05040001" in reason
    assert "then normal service" in reason


def test_a_node_that_aborts_a_new_initiate_and_serves_no_more_fails(tmp_path: Path) -> None:
    verdict, reason = verdicts(aborting(hangs=True), tmp_path, "CO-005", may_write=())["CO-005"]
    assert verdict is Verdict.FAILED
    assert "afterwards: abort" in reason


def test_the_general_abort_codes_for_lengths_and_values_are_accepted(tmp_path: Path) -> None:
    # CiA 301, 7.2.4.3.17 has a general code beside the specific ones, and does not say which of them an object needs.
    # A server may also check the length of a segmented download when the data is complete.
    only = ("CO-009a", "CO-009b", "CO-010a", "CO-010b", "CO-013a", "CO-013b")
    found = verdicts(general_codes, tmp_path, *only, may_write=((0x2000, 0),))
    assert {id: verdict for id, (verdict, _) in found.items()} == dict.fromkeys(only, Verdict.PASSED), found


def test_the_heartbeat_time_alone_serves_the_cases_that_need_a_number(tmp_path: Path) -> None:
    # They were skipped: "none of the objects given by --write is a number of 1, 2 or 4 bytes". 1017h is one of 2 bytes.
    found = verdicts(ours, tmp_path, *NEEDS_A_NUMBER, may_write=((0x1017, 0),))
    assert {id: verdict for id, (verdict, _) in found.items()} == dict.fromkeys(NEEDS_A_NUMBER, Verdict.PASSED), found


def test_blocks_are_checked_with_an_object_of_moderate_length(tmp_path: Path) -> None:
    # durand holds its EDS of two megabytes in 1021h. The check chose it, stopped after 200 blocks, and failed the node: "no end".
    sheet = LONG.replace("DefaultValue=a node for tests", f"DefaultValue={12_000 * 'n'}")

    async def serve(connection: CanConnection, clock: VirtualClock) -> None:
        await serve_node(connection, CanopenNode(parse_eds(sheet), NODE), clock)

    found = verdicts(serve, tmp_path, "CO-016", "CO-019", may_write=(), sheet=sheet)
    assert {verdict for verdict, _ in found.values()} == {Verdict.PASSED}, found


def test_a_skipped_case_describes_each_given_object(tmp_path: Path) -> None:
    found = verdicts(ours, tmp_path, *NEEDS_A_TEXT, may_write=((0x1017, 0), (0x5FFE, 0)))
    for verdict, reason in found.values():
        assert verdict is Verdict.SKIPPED
        assert "1017h:00 holds 2 bytes" in reason
        assert "5FFEh:00 could not be read (abort 06020000" in reason
    (found_number,) = verdicts(ours, tmp_path, "CO-029", may_write=((0x2004, 0), (0x5FFE, 0))).values()
    assert found_number[0] is Verdict.SKIPPED
    assert "2004h:00 is text or a domain in the EDS" in found_number[1]
    assert "5FFEh:00 could not be read" in found_number[1]
