"""The emulated node on the bus: NMT, error control, PDOs, SYNC and EMCY, row by row of the test-case list (CO-0xx)."""

from __future__ import annotations

import itertools

import pytest
from canopen_slave_rig import INCLINOMETER, NODE, RICH, U32, Rig, mux, var
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldtwin.emulators.canopen.eds.dictionary import load_eds
from fieldtwin.emulators.canopen.node import CanopenNode, NmtState, NodeContext
from fieldtwin.emulators.canopen.service import SentPdo
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.clock import NS_PER_MS
from fieldtwin.gateway.core.errors import UsageError

START, STOP, PRE, RESET_NODE, RESET_COMM = 1, 2, 128, 129, 130


@pytest.fixture
def rig() -> Rig:
    return Rig()


def tpdo1(rig: Rig, *, kind: int = 254, inhibit: int = 0, event: int = 0, sync_start: int = 0) -> None:
    """Configure TPDO1 as the standard requires and leave it valid."""
    cob = 0x180 + NODE
    for sub, value, size in ((1, 1 << 31 | cob, 4), (2, kind, 1), (3, inhibit, 2), (5, event, 2), (6, sync_start, 1)):
        assert rig.write(0x1800, sub, value, size) == ""
    assert rig.write(0x1800, 1, cob, 4) == ""


def times(sent: list[tuple[float, str]], can_id: str) -> list[float]:
    return [ms for ms, frame in sent if frame.startswith(can_id)]


# -- NMT ----------------------------------------------------------------------------------------------------------


def test_boot_up_and_states(rig: Rig) -> None:
    assert rig.boot == ["705#00"]
    assert rig.node.state is NmtState.PRE_OPERATIONAL
    for command, state in ((START, 5), (STOP, 4), (PRE, 127), (START, 5)):
        rig.nmt(command)
        assert rig.node.state == state
    assert [change.data[0] for change in rig.node.changes if change.what == "nmt"] == [0, 127, 5, 4, 127, 5]
    assert rig.node.counters.nmt_commands == 4


def test_a_node_without_power_is_silent() -> None:
    node = CanopenNode(load_eds(INCLINOMETER), 5)
    assert node.feed(CanFrame(0, b"\x01\x05"), 0) == []
    assert node.tick(10) == []
    assert node.wake_at_ns() is None


@pytest.mark.parametrize(("command", "application"), [(RESET_NODE, 7), (RESET_COMM, 99)])
def test_co_032_reset_restores_and_boots(rig: Rig, command: int, application: int) -> None:
    rig.write(0x2006, 0, 99, 2)
    rig.write(0x1017, 0, 100, 2)
    rig.nmt(START)
    assert rig.nmt(command) == ["705#00"]
    assert rig.node.state is NmtState.PRE_OPERATIONAL
    assert (rig.read(0x1017), rig.read(0x2006)) == (0, application)
    assert rig.advance(1000) == [], "the heartbeat is off again"


@pytest.mark.parametrize("data", ["", "01", "010500", "0180", "01FF", "0006", "0305"])
def test_co_033_bad_nmt_commands_are_ignored(rig: Rig, data: str) -> None:
    assert rig.send(0, data) == []
    assert rig.node.state is NmtState.PRE_OPERATIONAL


def test_nmt_for_another_node(rig: Rig) -> None:
    rig.nmt(START, 6)
    assert rig.node.state is NmtState.PRE_OPERATIONAL
    rig.nmt(START, 0)
    assert rig.node.state is NmtState.OPERATIONAL


def test_co_034_broadcast_reset_of_many_nodes() -> None:
    rigs = [Rig(node_id=n) for n in range(1, 128)]
    assert [rig.nmt(RESET_NODE, 0) for rig in rigs] == [[f"{0x700 + n:03X}#00"] for n in range(1, 128)]


def test_co_042_two_nodes_with_one_id_both_answer() -> None:
    assert [Rig().nmt(RESET_NODE), Rig().nmt(RESET_NODE)] == [["705#00"], ["705#00"]]


def test_co_060_extended_identifiers_mean_nothing(rig: Rig) -> None:
    assert rig.send(0, "0105", extended=True) == []
    assert rig.send(0x605, "4000100000000000", extended=True) == []
    assert rig.node.state is NmtState.PRE_OPERATIONAL
    assert rig.node.counters.ignored == 2


# -- error control ------------------------------------------------------------------------------------------------


def test_co_041_heartbeat_period_changes_at_once(rig: Rig) -> None:
    reply, more = rig.sdo_and_more("2B 1710 00 F401")
    assert (reply[:2], more) == ("60", ["705#7F"])
    assert times(rig.advance(1600), "705#7F") == [500, 1000, 1500]
    rig.sdo_and_more("2B 1710 00 6400")
    assert times(rig.advance(350), "705#7F") == [100, 200, 300]
    rig.nmt(START)
    assert [frame for _, frame in rig.advance(100)] == ["705#05"]
    rig.sdo_and_more("2B 1710 00 0000")
    assert rig.advance(1000) == []


def test_heartbeat_from_power_on_counts_from_the_boot_up() -> None:
    rig = Rig(var("1017", 6, "rw", 200))
    assert rig.advance(500) == [(200, "705#7F"), (400, "705#7F")]


def test_heartbeat_never_bursts(rig: Rig) -> None:
    rig.sdo_and_more("2B 1710 00 6400")
    rig.now_ns += 1050 * NS_PER_MS
    assert len(rig.node.tick(rig.now_ns)) == 1
    assert times(rig.advance(250), "705#7F") == [100, 200]


def test_co_041_no_1017h() -> None:
    rig = Rig(var("1000", U32, "ro", 0))
    assert rig.boot == ["705#00"]
    assert rig.advance(10_000) == []


def test_co_036_consumer_starts_with_the_first_heartbeat(rig: Rig) -> None:
    assert rig.write(0x1016, 1, 0x0A << 16 | 300, 4) == ""
    rig.nmt(START)
    assert times(rig.advance(1000), "085#") == [], "not heard yet, nothing to miss"
    rig.send(0x70A, "05")
    rig.advance(299)
    rig.send(0x70A, "05")  # CO-037: late, inside the time
    assert rig.node.active_errors == ()
    assert rig.advance(400) == [(300, "085#3081110000000000")]
    assert rig.node.state is NmtState.PRE_OPERATIONAL, "1029h:01 is 0"
    assert rig.read(0x1001) == 0x11
    assert rig.read(0x1003, 1) == 0x8130
    assert rig.send(0x70A, "00") == [], "CO-038: its boot-up alone is no heartbeat"
    assert rig.send(0x70A, "7F") == ["085#0000000000000000"]
    assert rig.node.active_errors == ()
    assert len(times(rig.advance(400), "085#3081")) == 1, "monitoring goes on"


def test_co_035_a_monitored_node_that_boots_is_monitored_again(rig: Rig) -> None:
    rig.write(0x1016, 1, 0x0A << 16 | 100, 4)
    rig.send(0x70A, "05")
    rig.send(0x70A, "00")
    assert rig.advance(1000) == [], "not missed while it starts"


@pytest.mark.parametrize(("reaction", "state"), [(0, 127), (1, 5), (2, 4)])
def test_co_036_reaction(rig: Rig, reaction: int, state: int) -> None:
    rig.write(0x1029, 1, reaction, 1)
    rig.write(0x1016, 1, 0x0A << 16 | 100, 4)
    rig.nmt(START)
    rig.send(0x70A, "05")
    rig.advance(100)
    assert rig.node.state == state


def test_co_039_odd_heartbeats_are_ignored_and_counted(rig: Rig) -> None:
    rig.write(0x1016, 1, 0x0A << 16 | 100, 4)
    for data in ("", "0500", "33"):
        rig.send(0x70A, data)
    assert rig.node.counters.ignored == 3
    assert rig.advance(500) == []


def test_one_node_is_watched_once(rig: Rig) -> None:
    rig.write(0x1016, 1, 0x0A << 16 | 100, 4)
    assert rig.write(0x1016, 2, 0x0A << 16 | 200, 4) == "06040043"
    assert rig.write(0x1016, 2, 0x0B << 16 | 200, 4) == ""


def test_co_040_guarding_is_answered_with_a_toggle(rig: Rig) -> None:
    assert [rig.send(0x705, remote=True) for _ in range(3)] == [["705#7F"], ["705#FF"], ["705#7F"]]
    rig.sdo_and_more("2B 1710 00 6400")
    assert rig.send(0x705, remote=True) == [], "one error control at a time"


# -- TPDO ---------------------------------------------------------------------------------------------------------


def test_tpdo_on_the_event_timer_without_drift(rig: Rig) -> None:
    tpdo1(rig, event=100)
    assert times(rig.advance(500), "185#") == [], "CO-044: none outside OPERATIONAL"
    assert rig.nmt(START) == ["185#00000000"]
    assert times(rig.advance(350), "185#") == [100, 200, 300]
    rig.now_ns += 130 * NS_PER_MS  # woken 80 ms late: the grid is kept
    assert len(rig.node.tick(rig.now_ns)) == 1
    assert times(rig.advance(120), "185#") == [20, 120]
    rig.nmt(STOP)
    assert times(rig.advance(500), "185#") == []


def test_tpdo_on_change_and_from_a_source() -> None:
    values = {(0x2000, 0): b"\0\0"}
    rig = Rig(RICH, NodeContext(source=lambda now_ns: dict(values)))
    rig.nmt(START)
    assert Rig.texts(rig.node.set_value(0x2002, 0, b"\x34\x12", rig.now_ns)) == ["185#00003412"]
    assert rig.node.set_value(0x2002, 0, b"\x34\x12", rig.now_ns) == [], "no change"
    assert rig.node.set_value(0x2006, 0, b"\x01\0", rig.now_ns) == [], "not mapped"
    values[0x2000, 0] = b"\xfe\xff"
    assert rig.read(0x2000) == 0xFFFE, "a read asks the source"
    tpdo1(rig, event=10)
    assert rig.advance(10) == [(10, "185#FEFF3412")]
    assert rig.node.journal[-1] == SentPdo(rig.now_ns, 0x185, b"\xfe\xff\x34\x12")
    assert rig.node.counters.tpdos == len(rig.node.journal) == 4  # two starts (OPERATIONAL, valid), change, timer


def test_a_source_that_does_not_fit_is_an_error() -> None:
    rig = Rig(RICH, NodeContext(source=lambda now_ns: {(0x2000, 0): b"\0"}))
    with pytest.raises(UsageError, match="2000h:00"):
        rig.nmt(START)


def test_co_050_inhibit_time_and_event_timer_together(rig: Rig) -> None:
    tpdo1(rig, inhibit=500, event=200)  # 50 ms, 200 ms
    rig.nmt(START)
    assert rig.node.set_value(0x2002, 0, b"\1\0", rig.now_ns) == [], "inhibited"
    assert times(rig.advance(49), "185#") == []
    assert rig.advance(1) == [(1, "185#00000100")]
    assert times(rig.advance(650), "185#") == [200, 400, 600], "the timer counts from the last transmission"
    tpdo1(rig, inhibit=1000, event=30)
    rig.advance(100)
    sent = times(rig.advance(1000), "185#")
    assert min(b - a for a, b in itertools.pairwise(sent)) == 100


def test_co_046_every_nth_sync(rig: Rig) -> None:
    tpdo1(rig, kind=3)
    assert rig.nmt(START) == []
    assert [len(rig.send(0x80)) for _ in range(9)] == [0, 0, 1] * 3


def test_co_046_sync_counter_and_start_value(rig: Rig) -> None:
    assert rig.write(0x1019, 0, 1, 1) == "06090030"
    assert rig.write(0x1019, 0, 241, 1) == "06090030"
    assert rig.write(0x1019, 0, 4, 1) == ""
    tpdo1(rig, kind=2, sync_start=3)
    rig.nmt(START)
    sent = [len(rig.send(0x80, f"{counter:02X}")) for counter in (1, 2, 3, 4, 1, 2, 3, 4)]
    assert sent == [0, 0, 0, 1, 0, 1, 0, 1], "counted from the SYNC whose counter is 3, over the wrap at 4"


def test_type_0_is_sent_at_the_sync_after_an_event(rig: Rig) -> None:
    tpdo1(rig, kind=0)
    rig.nmt(START)
    assert len(rig.send(0x80)) == 1
    assert rig.send(0x80) == []
    assert rig.node.set_value(0x2002, 0, b"\1\0", rig.now_ns) == []
    assert rig.send(0x80) == ["185#00000100"]


def test_co_047_sync_of_the_wrong_length(rig: Rig) -> None:
    tpdo1(rig, kind=1)
    rig.nmt(START)
    assert rig.send(0x80, "01") == ["085#4082110000000000"]
    assert rig.send(0x80) == ["185#00000000"]


def test_sync_in_pre_operational_sends_nothing(rig: Rig) -> None:
    tpdo1(rig, kind=1)
    assert rig.send(0x80) == []


def test_co_049_remote_frames(rig: Rig) -> None:
    tpdo1(rig, kind=253)
    rig.nmt(START)
    assert rig.send(0x185, remote=True) == ["185#00000000"]
    rig.node.set_value(0x2002, 0, b"\1\0", rig.now_ns)
    assert rig.send(0x185, remote=True) == ["185#00000100"]
    rig.write(0x1800, 1, 1 << 31 | 0x185, 4)
    rig.write(0x1800, 1, 1 << 30 | 0x185, 4)
    assert rig.send(0x185, remote=True) == []
    rig.nmt(PRE)
    assert rig.send(0x185, remote=True) == []


def test_type_252_is_sampled_at_sync(rig: Rig) -> None:
    tpdo1(rig, kind=252)
    rig.nmt(START)
    rig.send(0x80)
    rig.node.set_value(0x2002, 0, b"\1\0", rig.now_ns)
    assert rig.send(0x185, remote=True) == ["185#00000000"]
    rig.send(0x80)
    assert rig.send(0x185, remote=True) == ["185#00000100"]


# -- PDO parameters -----------------------------------------------------------------------------------------------


def test_co_051_remapping_while_valid_is_refused(rig: Rig) -> None:
    assert rig.write(0x1A00, 0, 0, 1) == "08000022"
    assert rig.write(0x1A00, 1, 0x20060010, 4) == "08000022"
    rig.write(0x1800, 1, 1 << 31 | 0x185, 4)
    assert rig.write(0x1A00, 1, 0x20020010, 4) == "08000022", "subindex 0 first"


def test_co_051_what_can_be_mapped(rig: Rig) -> None:
    rig.write(0x1800, 1, 1 << 31 | 0x185, 4)
    rig.write(0x1A00, 0, 0, 1)
    assert rig.write(0x1A00, 1, 0x20060010, 4) == "06040041", "not mappable"
    assert rig.write(0x1A00, 1, 0x20010008, 4) == "06040041", "rww goes to RPDOs only"
    assert rig.write(0x1A00, 1, 0x20020008, 4) == "06040041", "half an object"
    assert rig.write(0x1A00, 1, 0x30000008, 4) == "06020000"
    for sub in range(1, 6):
        assert rig.write(0x1A00, sub, 0x20020010, 4) == ""
    assert rig.write(0x1A00, 0, 5, 1) == "06040042"
    assert rig.write(0x1A00, 0, 9, 1) == "06040042"
    assert rig.write(0x1A00, 0, 4, 1) == ""


def test_remapping_by_the_book(rig: Rig) -> None:
    rig.nmt(START)
    rig.node.set_value(0x2002, 0, b"\x22\x11", rig.now_ns)
    assert rig.write(0x1800, 1, 1 << 31 | 0x185, 4) == ""
    assert rig.write(0x1A00, 0, 0, 1) == ""
    assert rig.write(0x1A00, 1, 0x20020010, 4) == ""
    assert rig.write(0x1A00, 2, 0x10010008, 4) == ""
    assert rig.write(0x1A00, 0, 2, 1) == ""
    reply, more = rig.sdo_and_more("23 0018 01 85010000")
    assert (reply[:2], more) == ("60", ["185#221100"])


def test_invalid_communication_parameters_are_refused(rig: Rig) -> None:
    assert rig.write(0x1800, 1, 0x186, 4) == "06090030", "no other identifier while valid"
    assert rig.write(0x1800, 3, 10, 2) == "06090030", "no other inhibit time while valid"
    assert rig.write(0x1800, 2, 241, 1) == "06090030"
    assert rig.write(0x1400, 2, 252, 1) == "06090030"
    rig.write(0x1800, 1, 1 << 31 | 0x185, 4)
    assert rig.write(0x1800, 1, 0x585 + 1, 4) == "06090030", "restricted"
    assert rig.write(0x1800, 1, 1 << 29 | 0x185, 4) == "06090030", "no 29-bit identifiers"
    assert rig.write(0x1800, 1, 0x1A0, 4) == ""
    assert rig.write(0x1005, 0, 1 << 29 | 0x80, 4) == "06090030", "no 29-bit identifiers"


# -- RPDO ---------------------------------------------------------------------------------------------------------


def test_rpdo_is_applied(rig: Rig) -> None:
    rig.nmt(START)
    assert rig.send(0x205, "0A0007") == ["185#0A000000"], "2000h is mapped to TPDO1 too: its change is an event"
    assert (rig.read(0x2000), rig.read(0x2001)) == (10, 7)
    assert [c.index for c in rig.node.changes if c.what == "rpdo"] == [0x2000, 0x2001]


def test_co_043_rpdo_too_short_and_too_long(rig: Rig) -> None:
    rig.nmt(START)
    assert rig.send(0x205, "0A00") == ["085#1082110000000000"]
    assert rig.read(0x2000) == 0
    rig.send(0x205, "0B0008FFFFFFFFFF")
    assert (rig.read(0x2000), rig.read(0x2001)) == (11, 8)


def test_co_044_rpdo_outside_operational(rig: Rig) -> None:
    assert rig.send(0x205, "0A0007") == []
    assert rig.read(0x2000) == 0


def test_co_045_synchronous_rpdo_with_a_dummy(rig: Rig) -> None:
    rig.nmt(START)
    rig.send(0x305, "FF0A00")
    assert rig.read(0x2000) == 0
    rig.send(0x80)
    assert rig.read(0x2000) == 10


def test_rpdo_outside_limits_is_refused_whole(rig: Rig) -> None:
    rig.nmt(START)
    rig.send(0x205, "0F2707")
    assert (rig.read(0x2000), rig.read(0x2001)) == (0, 0)
    assert rig.node.counters.rpdos_refused == 1


# -- EMCY ---------------------------------------------------------------------------------------------------------


def test_co_052_history_newest_first_and_inhibit_time(rig: Rig) -> None:
    rig.write(0x1015, 0, 1000, 2)  # 100 ms
    assert Rig.texts(rig.node.raise_error(0x3100, rig.now_ns, register=4, info=b"\xaa\xbb")) == ["085#003105AABB000000"]
    for number in (0x4200, 0x5000, 0x6100):
        assert rig.node.raise_error(number, rig.now_ns) == []
    assert [rig.read(0x1003, sub) for sub in (0, 1, 2, 3)] == [3, 0x6100, 0x5000, 0x4200]
    assert times(rig.advance(1000), "085#") == [100, 200, 300]
    rig.write(0x1003, 0, 0, 1)
    assert rig.read_code(0x1003, 1) == "08000024"


def test_co_054_reset_of_one_error_keeps_the_others(rig: Rig) -> None:
    rig.node.raise_error(0x3100, rig.now_ns, register=0x04)
    rig.node.raise_error(0x4200, rig.now_ns, register=0x08)
    assert Rig.texts(rig.node.clear_error(0x3100, rig.now_ns)) == ["085#0000090000000000"]
    assert rig.node.active_errors == (0x4200,)
    assert Rig.texts(rig.node.clear_error(0x4200, rig.now_ns)) == ["085#0000000000000000"]
    assert rig.node.clear_error(0x4200, rig.now_ns) == []


def test_emcy_burst_is_bounded_and_counted(rig: Rig) -> None:
    rig.write(0x1015, 0, 0xFFFF, 2)
    for number in range(100):
        rig.node.raise_error(0x1000 + number, rig.now_ns)
    assert rig.node.counters.emcys_dropped == 100 - 1 - 32


def test_no_emcy_when_stopped_or_invalid(rig: Rig) -> None:
    rig.write(0x1014, 0, 1 << 31 | 0x85, 4)
    assert rig.node.raise_error(0x3100, rig.now_ns) == []
    rig.nmt(RESET_NODE)
    rig.nmt(STOP)
    assert rig.node.raise_error(0x3100, rig.now_ns) == []
    assert rig.node.counters.emcys_dropped == 2


def test_values_that_no_emcy_can_carry(rig: Rig) -> None:
    for code, register, info in ((0x10000, 1, b""), (0, 1, b""), (0x1000, 256, b""), (0x1000, 1, bytes(6))):
        with pytest.raises(UsageError, match="EMCY"):
            rig.node.raise_error(code, rig.now_ns, register=register, info=info)


# -- arbitrary frames -----------------------------------------------------------------------------------------------

SOME_IDS = [0x000, 0x080, 0x185, 0x205, 0x305, 0x605, 0x705, 0x70A]
SETTINGS = [0x1005, 0x1014, 0x1015, 0x1016, 0x1017, 0x1019, 0x1400, 0x1600, 0x1800, 0x1A00, 0x1801, 0x1A01]
FRAMES = st.builds(
    CanFrame,
    st.sampled_from(SOME_IDS) | st.integers(0, 0x7FF),
    st.binary(max_size=8) | st.builds(lambda command: bytes([command, 0]), st.sampled_from([1, 2, 128, 129, 130])),
)
WRITES = st.builds(
    lambda index, sub, size, value: CanFrame(
        0x600 + NODE, bytes([0x23 | (4 - size) << 2]) + mux(index, sub) + value.to_bytes(4, "little")
    ),
    st.sampled_from(SETTINGS),
    st.integers(0, 6),
    st.sampled_from([1, 2, 4]),
    st.sampled_from([0, 1, 2, 254, 0x20000010, 0x20020010, 0x80000185, 0x185, 0xA0064]) | st.integers(0, 2**32 - 1),
)


@settings(max_examples=150, deadline=None)
@given(st.lists(st.tuples(FRAMES | WRITES, st.integers(0, 300)), max_size=40))
def test_any_frames_leave_a_working_node(traffic: list[tuple[CanFrame, int]]) -> None:
    rig = Rig()
    for frame, ms in traffic:
        rig.node.feed(frame, rig.now_ns)
        sent = len(rig.node.journal)
        state = rig.node.state
        rig.advance(ms)
        assert state is NmtState.OPERATIONAL or len(rig.node.journal) == sent, "no TPDO outside OPERATIONAL"
    assert "705#00" in rig.nmt(RESET_NODE)
    assert rig.read(0x1017) == 0
    assert rig.nmt(START) == ["185#00000000"]


# -- the reference device -----------------------------------------------------------------------------------------


def test_the_inclinometer_as_the_reference_system_configures_it() -> None:
    slopes = {(0x6010, 0): (-1234).to_bytes(2, "little", signed=True), (0x6020, 0): (4567).to_bytes(2, "little")}
    rig = Rig(INCLINOMETER.read_text(), NodeContext(source=lambda now_ns: slopes))
    assert rig.read(0x6010) == 0x10000 - 1234
    assert rig.write(0x1017, 0, 500, 2) == ""
    assert rig.write(0x1800, 1, 1 << 31 | 0x185, 4) == ""
    assert rig.write(0x1A00, 0, 0, 1) == ""
    assert rig.write(0x1A00, 1, 0x60100010, 4) == ""
    assert rig.write(0x1A00, 2, 0x60200010, 4) == ""
    assert rig.write(0x1A00, 0, 2, 1) == ""
    assert rig.write(0x1800, 2, 254, 1) == ""
    assert rig.write(0x1800, 5, 100, 2) == ""
    assert rig.write(0x1800, 1, 0x185, 4) == ""
    assert rig.nmt(START) == ["185#2EFBD711"]
    sent = rig.advance(1000)
    assert times(sent, "185#2EFBD711") == [100 * n for n in range(1, 11)]
    assert times(sent, "705#05") == [500, 1000]
    assert rig.write(0x6000, 0, 100, 2) == "06090031", "one resolution"
