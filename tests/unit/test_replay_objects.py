"""A recorded CANopen node holds again what it held, object by object, however the next master asks."""

from __future__ import annotations

import contextlib

import pytest
from canopen_slave_rig import RICH, Rig
from hypothesis import given
from hypothesis import strategies as st

from emulators.canopen.dictionary import parse_eds
from emulators.canopen.node import NodeContext
from emulators.context import UsedUp, WhenUsedUp
from emulators.replay.can_log import read_can_log
from emulators.replay.objects import RecordedObjects
from gateway.core.errors import FileInvalid

LOG = """\
(100.000000) can0 605#4018100400000000
(100.001000) can0 585#43181004EFBEADDE
(100.002000) can0 605#4004200000000000
(100.003000) can0 585#410420000A000000
(100.004000) can0 605#6000000000000000
(100.005000) can0 585#007265636F726465
(100.006000) can0 605#7000000000000000
(100.007000) can0 585#1964206F6B000000
(100.010000) can0 605#4006200000000000
(100.011000) can0 585#4B06200063000000
(100.012000) can0 605#2B06200064000000
(100.013000) can0 585#6006200000000000
(100.100000) can0 185#0A003412
(100.200000) can0 185#0A007856
(100.300000) can0 605#4002200000000000 R
(100.301000) can0 585#4B0220009A780000
(100.400000) can0 701#05
"""


def recorded(policy: WhenUsedUp = WhenUsedUp.HOLD) -> tuple[Rig, RecordedObjects]:
    objects = RecordedObjects(read_can_log(LOG.splitlines()), parse_eds(RICH), 5, policy)
    return Rig(RICH, NodeContext(source=objects, factory=objects.initial)), objects


def test_what_was_read_and_what_pdos_carried() -> None:
    rig, objects = recorded()
    assert objects.duration_s == pytest.approx(0.4)
    assert rig.read(0x1018, 4) == 0xDEADBEEF
    assert rig.sdo("40 0420 00") == "410420000A000000"
    assert rig.read(0x2002) == 0x1234, "what a TPDO carried, asked by SDO"
    rig.advance(250)
    assert rig.nmt(1) == ["185#0A007856"], "and as a TPDO"
    rig.advance(100)
    assert rig.read(0x2002) == 0x789A
    rig.advance(10_000)
    assert rig.read(0x2002) == 0x789A, "holds"


def test_what_the_recorded_master_wrote_is_a_setting() -> None:
    rig, _ = recorded()
    assert rig.read(0x2006) == 0x63, "as it was before it was written"
    assert rig.write(0x2006, 0, 7, 2) == ""
    rig.advance(1000)
    assert rig.read(0x2006) == 7


def test_at_the_end() -> None:
    rig, objects = recorded(WhenUsedUp.LOOP)
    assert rig.read(0x2002) == 0x1234
    rig.advance(390)
    assert rig.read(0x2002) == 0x789A
    rig.advance(objects.duration_s * 1000)
    rig.advance(20)
    assert rig.read(0x2002) == 0x1234
    rig, _ = recorded(WhenUsedUp.ERROR)
    assert rig.read(0x2002) == 0x1234
    rig.advance(500)
    with pytest.raises(UsedUp):
        rig.read(0x2002)


@given(text=st.text(max_size=80))
def test_any_text_is_a_log_or_refused(text: str) -> None:
    with contextlib.suppress(FileInvalid):
        list(read_can_log(text.splitlines(), "x.log"))


def test_a_broken_line_is_named() -> None:
    with pytest.raises(FileInvalid, match=r"x\.log:2: not a line of a CAN log"):
        list(read_can_log(["(1.0) can0 123#", "(1.0) can0 123##1AB"], "x.log"))
