"""The modes of the emulated drive beyond the profile ones: homing and the cyclic synchronous modes, and their bits in 6502h.

Defect: 6502h was copied from the data sheet, whatever the model supported, so a master chose a mode and the drive did not
move.
"""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from test_drive_model import ENABLE, QUICK_STOP, SHUTDOWN, SWITCH_ON, Rig, S

from fieldtwin.emulators.canopen.eds.dictionary import parse_eds
from fieldtwin.emulators.canopen.node import CanopenNode, NodeContext
from fieldtwin.emulators.models.canopen.emulated_node import NodeOptions, node_remarks
from fieldtwin.emulators.models.drive.drive import Drive
from fieldtwin.emulators.models.drive.homing import METHODS, DriveAxis, Speeds, plan
from fieldtwin.emulators.models.drive.motion import Motion, by_torque

DRIVE = (Path(__file__).parents[3] / "profiles" / "devices" / "drive-cia402.eds").read_text("ascii")

AXIS = DriveAxis()
PLACES = st.floats(-250_000, 250_000)
SPEED = st.floats(-50_000, 50_000)
BIT_10, BIT_11, BIT_12, BIT_13 = 1 << 10, 1 << 11, 1 << 12, 1 << 13
HOMING_BITS = BIT_10 | BIT_12 | BIT_13


def enabled(mode: int) -> Rig:
    rig = Rig()
    assert rig.write(0x6060, mode) == 0
    for word in (SHUTDOWN, SWITCH_ON, ENABLE):
        rig.command(word)
    assert rig.read(0x6061) == mode
    assert rig.state() is S.OPERATION_ENABLED
    return rig


# -- what exists ---------------------------------------------------------------------------------------------------------


def supported(sheet: str) -> int:
    node = CanopenNode(parse_eds(sheet), 7, NodeContext(model=Drive()))
    node.start(0)
    return node.data.number(0x6502)


def test_supported_modes_are_those_that_the_model_has() -> None:
    assert supported(DRIVE) == 0x3A5
    assert supported(DRIVE.replace("0x000003A5", "0x000003ED")) == 0x3A5, (
        "no velocity (2), torque (4) and interpolated mode (7)"
    )
    assert supported(DRIVE.replace("0x000003A5", "0x00000005")) == 0x005, "a data sheet may say fewer"
    assert supported(DRIVE.replace("DefaultValue=0x000003A5\n", "")) == 0x3A5, "a data sheet that says nothing"
    without = DRIVE.replace("[6071]", "[2071]").replace("[6098]", "[2098]")
    assert supported(without) == 0x185, "no homing and no torque mode without their objects"


def test_modes_that_a_data_sheet_promises_and_the_model_lacks_are_reported() -> None:
    model, options = Drive(), NodeOptions()
    sheet = parse_eds(DRIVE.replace("0x000003A5", "0x000003ED"))
    (remark,) = node_remarks(sheet, 7, model, options)
    assert "names modes that the drive model lacks: 4, 7" in remark.text
    assert node_remarks(parse_eds(DRIVE), 7, model, options) == []


@pytest.mark.parametrize("mode", [1, 3, 6, 8, 9, 10])
def test_every_supported_mode_can_be_chosen(mode: int) -> None:
    assert enabled(mode).read(0x6502) >> (mode - 1) & 1


@pytest.mark.parametrize(
    ("index", "good", "wrong"),
    [
        (0x605A, range(9), (-1, 9)),
        (0x605B, (0, 1), (2,)),
        (0x605D, range(1, 5), (0, 5)),
        (0x6098, METHODS, (15, 16, 31, 36, -1)),
    ],
)
def test_codes_that_the_model_lacks_are_refused(index: int, good: range, wrong: tuple[int, ...]) -> None:
    rig = Rig()
    assert [rig.write(index, code) for code in good] == [0] * len(good)
    assert all(rig.write(index, code) for code in wrong)


def test_supported_homing_methods_are_listed() -> None:
    rig = Rig()
    assert [rig.read(0x60E3, sub) for sub in range(1, rig.read(0x60E3) + 1)] == list(METHODS)


# -- homing --------------------------------------------------------------------------------------------------------------


def home_of(method: int) -> float:
    """The home position of each method, by the figures of the standard: an edge, or the next index pulse on one side of it."""
    a, b, low, high = AXIS.home_from, AXIS.home_to, AXIS.negative, AXIS.positive
    edges = {
        1: low, 2: high, 3: a, 4: a, 5: b, 6: b, 7: a, 8: a, 9: b, 10: b, 11: b, 12: b, 13: a, 14: a,
    }  # fmt: skip
    right = {1: True, 2: False, 3: False, 4: True, 5: True, 6: False, 7: False, 8: True, 9: False, 10: True, 11: True, 12: False,
             13: True, 14: False}  # fmt: skip
    if method >= 17:
        return edges[method - 16]
    pulses = [AXIS.index + n * AXIS.turn for n in range(-100, 100)]
    if right[method]:
        return min(pulse for pulse in pulses if pulse > edges[method])
    return max(pulse for pulse in pulses if pulse < edges[method])


@given(st.sampled_from([m for m in METHODS if m < 33]), PLACES, SPEED)
def test_homing_ends_at_the_place_of_its_method_wherever_it_begins(method: int, x: float, v: float) -> None:
    way = plan(method, AXIS, x, v, Speeds(20_000, 2_000, 100_000))
    kind = method if method < 17 else method - 16
    if way.home is None:  # a home switch without limit switches, approached from its wrong side
        assert (kind in (3, 4) and x > AXIS.home_to) or (kind in (5, 6) and x < AXIS.home_from)
    else:
        assert way.home == home_of(method)
        place, speed = way.motion.at(way.motion.duration_s)
        assert place == pytest.approx(way.home, abs=1e-3)
        assert speed == pytest.approx(0, abs=1e-3)


@given(st.sampled_from(METHODS), PLACES, SPEED, st.floats(100, 30_000), st.floats(10, 5_000), st.floats(1_000, 200_000))
@settings(max_examples=60)
def test_homing_exceeds_neither_speed_nor_acceleration(
    method: int, x: float, v: float, search: float, zero: float, acceleration: float
) -> None:
    way = plan(method, AXIS, x, v, Speeds(search, zero, acceleration))
    assert all(abs(a) <= acceleration * (1 + 1e-9) for _, a in way.motion.ramps)
    t, most = 0.0, max(abs(v), search, zero)
    for duration, _ in way.motion.ramps:
        t += duration
        assert abs(way.motion.at(t)[1]) <= most * (1 + 1e-6) + 1e-6


@given(PLACES)
@example(2_500.0)
def test_methods_33_and_34_take_the_next_index_pulse(x: float) -> None:
    left, right = (plan(method, AXIS, x, 0.0, Speeds(1, 1, 1)).home for method in (33, 34))
    assert left is not None
    assert right is not None
    assert left < x < right
    assert right - left in (pytest.approx(AXIS.turn), pytest.approx(2 * AXIS.turn))


@pytest.mark.parametrize("method", METHODS)
def test_homing_by_the_objects(method: int) -> None:
    """Status bits 10, 12 and 13: none while it runs, target reached and homing attained at its end. 607Ch counts then."""
    rig = enabled(6)
    assert rig.write(0x6098, method) == rig.write(0x607C, 1_234) == 0
    rig.command(ENABLE | 0x10)
    if method not in (35, 37, 5, 6, 21, 22):  # 5 and 6 end in an error from here
        assert rig.status & HOMING_BITS == 0
    rig.run(60_000)
    if method in (5, 6, 21, 22):
        assert rig.status & HOMING_BITS == BIT_10 | BIT_13
        return
    assert rig.status & HOMING_BITS == BIT_10 | BIT_12
    assert rig.read(0x6064) == 1_234
    if method < 33:
        assert rig.drive.position(rig.now_ns) == pytest.approx(home_of(method))


def test_positions_count_from_home_afterwards() -> None:
    rig = enabled(6)
    assert rig.write(0x6098, 18) == 0
    rig.command(ENABLE | 0x10)
    rig.run(60_000)
    assert rig.read(0x60FD) & 0b111 == 0b010, "on the positive limit switch"
    rig.command(ENABLE)
    assert rig.write(0x6060, 1) == rig.write(0x607A, -5_000) == 0
    rig.command(ENABLE | 0x10)
    rig.run(5_000)
    assert rig.read(0x6064) == -5_000
    assert rig.drive.position(rig.now_ns) == pytest.approx(AXIS.positive - 5_000)


@pytest.mark.parametrize("word", [ENABLE, ENABLE | 0x110], ids=["bit 4 falls", "halt"])
def test_interrupted_homing_stops_and_is_not_attained(word: int) -> None:
    rig = enabled(6)
    assert rig.write(0x6098, 2) == 0
    rig.command(ENABLE | 0x10)
    rig.run(1_000)
    assert rig.read(0x606C) > 0
    rig.command(word)
    rig.run(5_000)
    assert rig.read(0x606C) == 0
    assert rig.status & HOMING_BITS == BIT_10


# -- cyclic synchronous modes ------------------------------------------------------------------------------------------------


@given(st.lists(st.integers(-3_000, 3_000), min_size=1, max_size=20))
@example([79, -5, -108, 42])  # the motor is at the last target when it comes, too fast to stop there
@settings(max_examples=40)
def test_cyclic_position_reaches_each_end_and_keeps_the_limits(steps: list[int]) -> None:
    rig = enabled(8)
    assert rig.write(0x607F, 100_000) == rig.write(0x60C5, 1_000_000) == rig.write(0x60C6, 1_000_000) == 0
    place, speed = 0, 0.0
    for step in steps:
        place += step
        assert rig.write(0x607A, place) == 0
        for _ in range(10):
            rig.run(1)
            now = rig.drive.velocity(rig.now_ns)
            assert abs(now) <= 100_000 * (1 + 1e-9)
            assert abs(now - speed) <= 1_000_000 * 0.001 * (1 + 1e-6)
            speed = now
        assert rig.status & BIT_12, "the drive follows the command"
        assert rig.read(0x6062) == place
        assert rig.read(0x60F4) == place - rig.read(0x6064)
    rig.run(5_000)
    assert rig.read(0x6064) == place
    assert rig.read(0x60F4) == 0


def test_cyclic_position_reports_a_following_error_and_the_limits() -> None:
    rig = enabled(8)
    assert rig.write(0x6065, 100) == rig.write(0x607D, -1_000, 1) == rig.write(0x607D, 50_000, 2) == 0
    assert rig.write(0x607A, 80_000) == 0
    assert rig.status & (BIT_11 | BIT_13) == BIT_11 | BIT_13
    rig.run(10_000)
    assert rig.read(0x6064) == 50_000
    assert rig.status & (BIT_11 | BIT_13) == BIT_11
    assert rig.write(0x607A, 49_990) == 0
    assert rig.status & BIT_11 == 0


@given(st.integers(-700_000, 700_000), st.integers(-700_000, 700_000))
@settings(max_examples=40)
def test_cyclic_velocity_reaches_the_target_within_the_limits(target: int, offset: int) -> None:
    rig = enabled(9)
    assert rig.write(0x60FF, target) == rig.write(0x60B1, offset) == 0
    rig.run(10_000)
    wanted = target + offset
    assert rig.read(0x606C) == max(-500_000, min(500_000, wanted))
    assert bool(rig.status & BIT_11) == (abs(wanted) > 500_000)
    assert rig.status & BIT_12


@given(st.floats(-1e6, 1e6), st.floats(-1e6, 1e6), st.floats(1, 1e5), st.floats(1, 1e6))
def test_a_torque_never_drives_the_motor_beyond_its_speed(
    v: float, acceleration: float, friction: float, fastest: float
) -> None:
    ramps = by_torque(v, acceleration, friction, fastest)
    motion = Motion(0.0, v, ramps)
    end = motion.at(motion.duration_s)[1]
    assert abs(end) <= fastest * (1 + 1e-6)
    assert all(abs(a) <= abs(acceleration) + friction * (1 + 1e-9) for _, a in ramps)
    if abs(acceleration) < friction:
        assert end == pytest.approx(0, abs=1e-3), "friction outweighs the torque"
    elif abs(acceleration) > friction * 1.001:  # a double keeps about 16 digits of the larger speed
        assert end == pytest.approx(math.copysign(fastest, acceleration), abs=1e-9 * max(abs(v), fastest))


def test_cyclic_torque_accelerates_the_motor_and_is_bounded() -> None:
    rig = enabled(10)
    assert rig.write(0x6072, 500) == rig.write(0x6071, 800) == 0
    assert rig.read(0x6077) == rig.read(0x6074) == 500
    assert rig.status & (BIT_11 | BIT_12) == BIT_11 | BIT_12
    rig.run(100)
    assert rig.read(0x606C) == pytest.approx(0.1 * (250_000 - 20_000), rel=0.01), (
        "half the rated torque, less the friction"
    )
    assert rig.write(0x6071, 0) == 0
    rig.run(10_000)
    assert (rig.read(0x606C), rig.read(0x6077)) == (0, 0)


@pytest.mark.parametrize("mode", [8, 9, 10])
def test_halt_stops_a_cyclic_mode_and_the_drive_resumes_afterwards(mode: int) -> None:
    rig = enabled(mode)
    target = {8: 0x607A, 9: 0x60FF, 10: 0x6071}[mode]
    assert rig.write(0x607F, 20_000) == rig.write(target, 900 if mode == 10 else 30_000) == 0
    rig.run(200)
    assert rig.read(0x606C) > 0
    rig.command(ENABLE | 0x100)
    rig.run(3_000)
    assert rig.read(0x606C) == 0
    assert rig.status & BIT_10
    rig.command(ENABLE)
    rig.run(200)
    assert rig.read(0x606C) > 0


@pytest.mark.parametrize("mode", [3, 8, 9, 10])
@pytest.mark.parametrize("option", range(9))
def test_quick_stop_options(mode: int, option: int) -> None:
    """605Ah: 0 switches off at once, 1 to 4 stop and switch off, 5 to 8 stop and stay in quick stop active."""
    rig = enabled(mode)
    target = {3: 0x60FF, 8: 0x607A, 9: 0x60FF, 10: 0x6071}[mode]
    assert (
        rig.write(0x605A, option) == rig.write(0x607F, 20_000) == rig.write(target, 900 if mode == 10 else 30_000) == 0
    )
    rig.run(500)
    speed = rig.read(0x606C)
    assert speed > 0
    rig.command(QUICK_STOP)
    rate = [20_000, 100_000, 400_000, 500_000, 520_000][option - 4 if option > 4 else option]
    assert rig.state() is (S.QUICK_STOP if option else S.SWITCH_ON_DISABLED)
    rig.run(1_000 * speed / rate + 1)
    assert rig.read(0x606C) == 0
    assert rig.state() is (S.QUICK_STOP if option >= 5 else S.SWITCH_ON_DISABLED)
