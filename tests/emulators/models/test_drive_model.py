"""The CiA 402 drive: every transition of its state machine, all inputs without a transition, and the motion of the motor."""

from __future__ import annotations

from itertools import product
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldtwin.emulators.canopen.eds.dictionary import load_eds
from fieldtwin.emulators.canopen.node import CanopenNode, NodeContext
from fieldtwin.emulators.canopen.service import NmtState
from fieldtwin.emulators.models.drive.drive import Drive
from fieldtwin.emulators.models.drive.motion import Motion, to_place, to_speed
from fieldtwin.emulators.models.drive.states import (
    STATE_MASK,
    TRANSITIONS,
    DriveState,
    TransitionCause,
    command_of,
    transition,
)
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.clock import NS_PER_MS, NS_PER_S

EDS = load_eds(Path(__file__).parents[3] / "profiles" / "devices" / "drive-cia402.eds")
NODE = 7
S = DriveState
SHUTDOWN, SWITCH_ON, ENABLE, DISABLE_VOLTAGE, QUICK_STOP, RESET = 0x06, 0x07, 0x0F, 0x00, 0x02, 0x80


class Rig:
    """A started node with a drive model, and access to its objects. Time in milliseconds."""

    def __init__(self, ready: bool = True) -> None:
        self.drive = Drive()
        self.node = CanopenNode(EDS, NODE, NodeContext(model=self.drive))
        self.now_ns = NS_PER_S
        self.node.start(self.now_ns)
        self.sent = self.node.feed(CanFrame(0, bytes([1, NODE])), self.now_ns)
        if ready:
            self.run(20)

    def run(self, ms: float) -> None:
        """Let time pass, ticking when the node requests it."""
        until_ns = self.now_ns + round(ms * NS_PER_MS)
        while (wake_ns := self.node.wake_at_ns()) is not None and wake_ns <= until_ns:
            self.now_ns = max(wake_ns, self.now_ns)
            self.sent += self.node.tick(self.now_ns)
        self.now_ns = until_ns
        self.sent += self.node.tick(until_ns)

    def write(self, index: int, value: int, sub: int = 0) -> int:
        """Make an expedited download; return the abort code, 0 on success."""
        entry = EDS.entry(index, sub)
        assert entry is not None
        assert entry.size is not None
        raw = (value & ((1 << 8 * entry.size) - 1)).to_bytes(4, "little")
        request = bytes([0x23 | (4 - entry.size) << 2]) + index.to_bytes(2, "little") + bytes([sub]) + raw
        reply = next(f for f in self._feed(0x600 + NODE, request) if f.can_id == 0x580 + NODE)
        return int.from_bytes(reply.data[4:], "little") if reply.data[0] == 0x80 else 0

    def read(self, index: int, sub: int = 0, *, signed: bool = True) -> int:
        request = b"\x40" + index.to_bytes(2, "little") + bytes([sub, 0, 0, 0, 0])
        reply = next(f for f in self._feed(0x600 + NODE, request) if f.can_id == 0x580 + NODE)
        size = 4 - (reply.data[0] >> 2 & 3)
        return int.from_bytes(reply.data[4 : 4 + size], "little", signed=signed)

    def _feed(self, can_id: int, data: bytes) -> list[CanFrame]:
        out = self.node.feed(CanFrame(can_id, data), self.now_ns)
        self.sent += out
        return out

    def command(self, controlword: int) -> None:
        assert self.write(0x6040, controlword) == 0

    @property
    def status(self) -> int:
        return self.read(0x6041, signed=False)

    def state(self) -> DriveState:
        """Return the state as a master decodes it from the statusword."""
        word = self.status
        found = [s for s in S if word & STATE_MASK == s.value]
        assert found == [self.drive.state]
        return found[0]

    def bring_to(self, state: DriveState) -> None:
        """Take the shortest path from SWITCH ON DISABLED."""
        ways = {
            S.SWITCH_ON_DISABLED: [], S.READY: [SHUTDOWN], S.SWITCHED_ON: [SHUTDOWN, SWITCH_ON],
            S.OPERATION_ENABLED: [SHUTDOWN, SWITCH_ON, ENABLE], S.QUICK_STOP: [SHUTDOWN, SWITCH_ON, ENABLE, QUICK_STOP],
        }  # fmt: skip
        if state in (S.QUICK_STOP, S.FAULT_REACTION):  # both last only while there is motion to stop
            self.spin()
        for word in ways.get(state, []):
            self.command(word)
        if state in (S.FAULT, S.FAULT_REACTION):
            self.node.raise_error(0x2310, self.now_ns)
        assert self.state() is state

    def spin(self, speed: int = 10_000) -> None:
        """Operation enabled in profile velocity mode, and at speed."""
        assert self.write(0x6060, 3) == self.write(0x60FF, speed) == 0
        for word in (SHUTDOWN, SWITCH_ON, ENABLE):
            self.command(word)
        self.run(2_000)
        assert self.read(0x606C) == speed


# The states that can be reached and held, and the result of each controlword in them (CiA 402-2, "Power drive system FSA").
COMMANDED = {
    (S.SWITCH_ON_DISABLED, SHUTDOWN): (S.READY, [2]),
    (S.READY, SWITCH_ON): (S.SWITCHED_ON, [3]),
    (S.READY, ENABLE): (S.OPERATION_ENABLED, [3, 4]),
    (S.READY, DISABLE_VOLTAGE): (S.SWITCH_ON_DISABLED, [7]),
    (S.READY, QUICK_STOP): (S.SWITCH_ON_DISABLED, [7]),
    (S.SWITCHED_ON, ENABLE): (S.OPERATION_ENABLED, [4]),
    (S.SWITCHED_ON, SHUTDOWN): (S.READY, [6]),
    (S.SWITCHED_ON, DISABLE_VOLTAGE): (S.SWITCH_ON_DISABLED, [10]),
    (S.SWITCHED_ON, QUICK_STOP): (S.SWITCH_ON_DISABLED, [10]),
    (S.OPERATION_ENABLED, SWITCH_ON): (S.SWITCHED_ON, [5]),
    (S.OPERATION_ENABLED, SHUTDOWN): (S.READY, [8]),
    (S.OPERATION_ENABLED, DISABLE_VOLTAGE): (S.SWITCH_ON_DISABLED, [9]),
    (S.QUICK_STOP, DISABLE_VOLTAGE): (S.SWITCH_ON_DISABLED, [12]),
    (S.FAULT, RESET): (S.SWITCH_ON_DISABLED, [15]),
}
HELD = [s for s in S if s is not S.NOT_READY]
WORDS = [SHUTDOWN, SWITCH_ON, ENABLE, DISABLE_VOLTAGE, QUICK_STOP, RESET]


EVERY = [pair for pair in product(HELD, WORDS) if pair != (S.OPERATION_ENABLED, QUICK_STOP)]
"""That one passes through two states: below."""


@pytest.mark.parametrize(("state", "word"), EVERY, ids=lambda v: getattr(v, "name", f"{v}"))
def test_every_command_in_every_state(state: DriveState, word: int) -> None:
    """The transitions of the standard and no others: a command is executed or ignored, never aborted."""
    rig = Rig()
    rig.bring_to(state)
    before = len(rig.drive.transitions)
    rig.command(word)
    target, numbers = COMMANDED.get((state, word), (state, []))
    assert rig.state() is target
    assert rig.drive.transitions[before:] == numbers


def test_automatic_transitions_and_their_duration() -> None:
    rig = Rig(ready=False)
    assert rig.state() is S.NOT_READY
    rig.command(SHUTDOWN)
    assert rig.state() is S.NOT_READY  # too early, and dropped
    rig.run(20)
    assert rig.state() is S.SWITCH_ON_DISABLED
    assert rig.drive.transitions == [1]
    rig.spin(40_000)
    rig.command(QUICK_STOP)
    assert rig.state() is S.QUICK_STOP
    assert rig.drive.transitions[-1] == 11
    rig.run(99)  # 40,000 inc/s at 400,000 inc/s2
    assert rig.state() is S.QUICK_STOP
    assert rig.read(0x606C) > 0
    rig.run(1)
    assert rig.state() is S.SWITCH_ON_DISABLED
    assert rig.drive.transitions[-1] == 12
    assert rig.read(0x606C) == 0


@pytest.mark.parametrize("option", [5, 6, 7, 8])
def test_a_quick_stop_that_stays_can_be_left_for_operation(option: int) -> None:
    rig = Rig()
    rig.write(0x605A, option)
    rig.spin()
    rig.command(QUICK_STOP)
    rig.run(500)
    assert rig.state() is S.QUICK_STOP
    assert rig.status & 1 << 10
    rig.command(ENABLE)
    assert rig.state() is S.OPERATION_ENABLED
    assert rig.drive.transitions[-1] == 16
    rig.run(500)
    assert rig.read(0x606C) == 10_000


def test_without_that_option_a_quick_stop_cannot_be_left() -> None:
    rig = Rig()
    rig.spin()
    rig.command(QUICK_STOP)
    rig.command(ENABLE)
    assert rig.state() is S.QUICK_STOP


def test_quick_stop_option_0_disables_at_once() -> None:
    rig = Rig()
    rig.write(0x605A, 0)
    rig.spin()
    rig.command(QUICK_STOP)
    assert rig.state() is S.SWITCH_ON_DISABLED
    assert rig.drive.transitions[-2:] == [11, 12]
    assert rig.read(0x606C) == 10_000  # and the motor coasts
    rig.run(501)
    assert rig.read(0x606C) == 0


@pytest.mark.parametrize("state", [s for s in HELD if s not in (S.FAULT, S.FAULT_REACTION)])
def test_an_error_is_a_fault_from_every_state(state: DriveState) -> None:
    rig = Rig()
    rig.bring_to(state)
    rig.sent.clear()
    rig.node.raise_error(0x2310, rig.now_ns)
    moving = state is S.QUICK_STOP
    assert rig.state() is (S.FAULT_REACTION if moving else S.FAULT)
    rig.run(200)
    assert rig.state() is S.FAULT
    assert rig.drive.transitions[-2:] == [13, 14]
    assert rig.read(0x603F, signed=False) == 0x2310
    rig.command(RESET)
    assert rig.state() is S.SWITCH_ON_DISABLED
    assert rig.node.active_errors == ()
    assert rig.read(0x603F, signed=False) == 0
    assert rig.node.data.get(0x1001) == b"\0"


def test_a_fault_reset_is_an_edge() -> None:
    rig = Rig()
    rig.command(RESET)
    rig.bring_to(S.FAULT)
    rig.command(RESET)  # bit 7 was set before: no edge
    assert rig.state() is S.FAULT
    rig.command(0)
    rig.command(RESET)
    assert rig.state() is S.SWITCH_ON_DISABLED


@pytest.mark.parametrize(
    ("option", "state"), [(0, S.OPERATION_ENABLED), (1, S.FAULT), (2, S.SWITCH_ON_DISABLED), (3, S.QUICK_STOP)]
)
def test_the_abort_connection_option_decides_the_reaction_to_a_lost_connection(option: int, state: DriveState) -> None:
    rig = Rig()
    rig.write(0x6007, option)
    rig.write(0x1029, 1, sub=1)  # no change of NMT state
    rig.write(0x1016, 0x01 << 16 | 100, sub=1)
    if state is S.QUICK_STOP:
        rig.write(0x605A, 6)
    rig.spin()
    rig.node.feed(CanFrame(0x701, b"\x05"), rig.now_ns)
    rig.run(300)
    assert 0x8130 in rig.node.active_errors
    assert rig.state() is state


def test_a_fault_by_a_lost_connection_cannot_be_reset_before_it_is_back() -> None:
    rig = Rig()
    rig.write(0x1029, 1, sub=1)
    rig.write(0x1016, 0x01 << 16 | 100, sub=1)
    rig.node.feed(CanFrame(0x701, b"\x05"), rig.now_ns)
    rig.run(200)
    rig.command(RESET)
    assert rig.state() is S.FAULT
    rig.node.feed(CanFrame(0x701, b"\x05"), rig.now_ns)
    rig.command(0)
    rig.command(RESET)
    assert rig.state() is S.SWITCH_ON_DISABLED


def test_profile_position_with_its_handshake() -> None:
    rig = Rig()
    rig.write(0x6060, 1)
    assert rig.read(0x6061) == 1
    for word in (SHUTDOWN, SWITCH_ON, ENABLE):
        rig.command(word)
    rig.write(0x607A, 50_000)
    assert not rig.status & 1 << 12
    rig.command(ENABLE | 1 << 4)
    assert rig.status & 1 << 12
    assert not rig.status & 1 << 10
    rig.command(ENABLE)
    assert not rig.status & 1 << 12
    rig.run(750)  # 0.5 s up to 50,000 inc/s, then on
    assert (rig.read(0x6064), rig.read(0x606C)) == (25_000, 50_000)
    rig.run(750)
    assert (rig.read(0x6064), rig.read(0x606C)) == (50_000, 0)
    assert rig.status & 1 << 10
    rig.write(0x607A, -10_000)
    rig.command(ENABLE | 1 << 4 | 1 << 6)  # relative
    rig.run(5_000)
    assert rig.read(0x6064) == 40_000


def test_a_second_set_point_waits_or_takes_over_according_to_bit_5() -> None:
    places = {}
    for at_once in (0, 1 << 5):
        rig = Rig()
        rig.write(0x6060, 1)
        for word in (SHUTDOWN, SWITCH_ON, ENABLE):
            rig.command(word)
        rig.write(0x607A, 50_000)
        rig.command(ENABLE | 1 << 4)
        rig.command(ENABLE)
        rig.run(500)
        rig.write(0x607A, 0)
        rig.command(ENABLE | 1 << 4 | at_once)
        rig.command(ENABLE)
        assert bool(rig.status & 1 << 12) == (not at_once)  # the waiting one still has the only place
        rig.run(1_000)
        places[at_once] = rig.read(0x6064)
        rig.run(5_000)
        assert rig.read(0x6064) == 0
        assert not rig.status & 1 << 12
    assert places[0] > 45_000  # it had gone there first
    assert places[1 << 5] < 40_000


def test_a_third_set_point_finds_no_place() -> None:
    rig = Rig()
    rig.write(0x6060, 1)
    for word in (SHUTDOWN, SWITCH_ON, ENABLE):
        rig.command(word)
    for place in (50_000, 60_000, 70_000):
        rig.write(0x607A, place)
        rig.command(ENABLE | 1 << 4)
        rig.command(ENABLE)
    rig.run(6_000)
    assert rig.read(0x6064) == 60_000


def test_halt_stops_and_resumes() -> None:
    rig = Rig()
    rig.spin()
    rig.command(ENABLE | 1 << 8)
    rig.run(200)
    assert rig.read(0x606C) == 0
    assert rig.status & 1 << 10
    assert rig.state() is S.OPERATION_ENABLED
    rig.command(ENABLE)
    rig.run(200)
    assert rig.read(0x606C) == 10_000


def test_limits_are_observed_and_reported() -> None:
    rig = Rig()
    rig.spin()
    rig.write(0x60FF, 600_000)
    rig.run(6_000)
    assert rig.read(0x606C) == 500_000
    assert rig.status & 1 << 11
    rig = Rig()
    rig.write(0x607D, -100, sub=1)
    rig.write(0x607D, 1_000, sub=2)
    rig.write(0x6060, 1)
    rig.write(0x607A, 5_000)
    for word in (SHUTDOWN, SWITCH_ON, ENABLE, ENABLE | 1 << 4):
        rig.command(word)
    rig.run(2_000)
    assert rig.read(0x6064) == 1_000
    assert rig.status & 1 << 11


def test_a_mode_that_the_drive_has_not_is_refused_by_sdo_and_ignored_by_pdo() -> None:
    rig = Rig()
    assert rig.write(0x6060, 3) == 0
    assert rig.write(0x6060, 7) == 0x06090030
    rig.node.feed(CanFrame(0x300 + NODE, b"\0\0\x07"), rig.now_ns)
    assert rig.read(0x6060) == 7
    assert rig.read(0x6061) == 3


def test_a_drive_is_controlled_by_pdos_alone() -> None:
    """RPDO4 with controlword and target velocity; TPDO4 answers each change of the statusword by itself."""
    rig = Rig()
    rig.write(0x6060, 3)
    rig.sent.clear()
    for word in (SHUTDOWN, SWITCH_ON, ENABLE):
        rig.sent += rig.node.feed(
            CanFrame(0x500 + NODE, word.to_bytes(2, "little") + (5_000).to_bytes(4, "little")), rig.now_ns
        )
    words = [int.from_bytes(f.data[:2], "little") & STATE_MASK for f in rig.sent if f.can_id == 0x180 + NODE]
    assert words == [S.READY.value, S.SWITCHED_ON.value, S.OPERATION_ENABLED.value]
    rig.run(100)
    assert rig.read(0x606C) == 5_000


def test_the_same_controlword_again_is_a_command_again() -> None:
    """A master that sends its RPDO in a cycle: a command that came too early counts the next time."""
    rig = Rig(ready=False)
    pdo = CanFrame(0x200 + NODE, SHUTDOWN.to_bytes(2, "little"))
    rig.node.feed(pdo, rig.now_ns)
    rig.run(20)
    assert rig.state() is S.SWITCH_ON_DISABLED
    rig.node.feed(pdo, rig.now_ns)
    assert rig.state() is S.READY


def test_reset_node_restarts_and_reset_communication_does_not_affect_the_drive() -> None:
    rig = Rig()
    rig.spin()
    rig.node.feed(CanFrame(0, bytes([130, NODE])), rig.now_ns)
    assert rig.node.state is NmtState.PRE_OPERATIONAL
    assert rig.state() is S.OPERATION_ENABLED
    assert rig.read(0x606C) == 10_000
    rig.node.feed(CanFrame(0, bytes([129, NODE])), rig.now_ns)
    assert rig.state() is S.NOT_READY
    rig.run(1_000)
    assert rig.state() is S.SWITCH_ON_DISABLED
    assert rig.read(0x606C) == 0


def test_recorded_objects_are_replayed_and_never_computed() -> None:
    played = {(0x6079, 0): (325_000).to_bytes(4, "little"), (0x6064, 0): (77).to_bytes(4, "little")}
    node = CanopenNode(EDS, NODE, NodeContext(source=lambda now_ns: dict(played), model=Drive()))
    node.start(0)
    node.feed(CanFrame(0x600 + NODE, bytes.fromhex("4064600000000000")), 1)
    assert node.data.number(0x6079) == 325_000
    assert node.data.number(0x6064) == 77


# -- the table and the ramps by themselves ------------------------------------------------------------------------------


def test_the_table_has_every_number_once_a_pair_and_no_other_way_out_of_a_fault() -> None:
    assert {t.number for t in TRANSITIONS} == set(range(1, 17))
    assert len({(t.source, t.cause) for t in TRANSITIONS}) == len(TRANSITIONS)
    assert [t for t in TRANSITIONS if t.source is S.FAULT and t.cause is not TransitionCause.FAULT_RESET] == []
    for state, cause in product(S, TransitionCause):
        found = transition(state, cause)
        assert found is None or (found.source, found.cause) == (state, cause)


@pytest.mark.parametrize(
    ("word", "cause"),
    [(0x00, TransitionCause.DISABLE_VOLTAGE), (0x0D, TransitionCause.DISABLE_VOLTAGE),
     (0x02, TransitionCause.QUICK_STOP), (0x0B, TransitionCause.QUICK_STOP),
     (0x06, TransitionCause.SHUTDOWN), (0x0E, TransitionCause.SHUTDOWN),
     (0x07, TransitionCause.SWITCH_ON), (0x0F, TransitionCause.ENABLE_OPERATION),
     (0x80, TransitionCause.FAULT_RESET), (0x8F, TransitionCause.FAULT_RESET)],
)  # fmt: skip
def test_controlwords_are_decoded_to_commands(word: int, cause: TransitionCause) -> None:
    assert command_of(word, 0) is cause
    assert command_of(word | 0x80, 0x80) is None


rates = st.floats(10, 1e6)


@settings(max_examples=60)
@given(st.floats(-1e6, 1e6), st.floats(-1e5, 1e5), st.floats(1, 1e5), rates, rates)
def test_a_motion_ends_at_its_target_at_standstill_and_within_its_limits(
    distance: float, v: float, cruise: float, up: float, down: float
) -> None:
    ramps = to_place(distance, v, cruise, up, down)
    motion = Motion(0.0, v, ramps)
    x, end = motion.at(motion.duration_s + 1)
    assert x == pytest.approx(distance, abs=1e-6 * (1 + abs(distance) + v * v / down))
    assert end == pytest.approx(0.0, abs=1e-5 * (1 + abs(v) + cruise))
    for _, a in ramps:
        assert abs(a) <= max(up, down) * (1 + 1e-9)
    for n in range(20):
        assert abs(motion.at(motion.duration_s * n / 20)[1]) <= max(abs(v), cruise) * (1 + 1e-9)


@settings(max_examples=60)
@given(st.floats(-1e5, 1e5), st.floats(-1e5, 1e5), rates, rates)
def test_a_ramp_ends_at_its_speed(v: float, target: float, up: float, down: float) -> None:
    motion = Motion(0.0, v, to_speed(v, target, up, down))
    assert motion.at(motion.duration_s)[1] == pytest.approx(target, abs=1e-6 * (1 + abs(v) + abs(target)))
