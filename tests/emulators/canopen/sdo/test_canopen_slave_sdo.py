"""The emulated node's SDO server, row by row of the test-case list (CO-0xx), and under any interleaving."""

from __future__ import annotations

import pytest
from canopen_slave_rig import NODE, RICH, Rig, code, mux
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from fieldtwin.emulators.canopen.node import NmtState, NodeContext

NAME = b"a node for tests"


@pytest.fixture
def rig() -> Rig:
    return Rig()


def test_expedited_in_both_directions(rig: Rig) -> None:
    assert rig.sdo("2B 0620 00 3412") == "6006200000000000"
    assert rig.sdo("40 0620 00") == "4B06200034120000"


def test_segmented_upload_bytes(rig: Rig) -> None:
    assert rig.sdo("40 0810 00") == "4108100010000000"
    assert rig.sdo("60") == "00" + NAME[:7].hex().upper()
    assert rig.sdo("70") == "10" + NAME[7:14].hex().upper()
    assert rig.sdo("60") == "0B" + NAME[14:].hex().upper() + "0000000000"
    assert code(rig.sdo("70")) == "05040001", "the transfer is over"


def test_segmented_download_bytes(rig: Rig) -> None:
    assert rig.sdo("21 0420 00 09000000") == "6004200000000000"
    assert rig.sdo("00" + b"abcdefg".hex()) == "2000000000000000"
    assert rig.sdo("1B" + b"hi".hex()) == "3000000000000000"
    assert rig.node.data.get(0x2004) == b"abcdefghi"
    assert [(c.what, c.index, c.data) for c in rig.node.changes][-1] == ("write", 0x2004, b"abcdefghi")


def test_co_001_toggle_repeated(rig: Rig) -> None:
    rig.sdo("40 0810 00")
    rig.sdo("60")
    assert rig.sdo("60") == "8008100000000305"
    assert code(rig.sdo("70")) == "05040001"
    rig.sdo("21 0420 00 09000000")
    assert code(rig.sdo("10" + b"abcdefg".hex())) == "05030000", "the first segment has toggle 0"
    assert rig.node.data.get(0x2004) == b"hello"


def test_co_002_client_aborts(rig: Rig) -> None:
    rig.sdo("40 0810 00")
    assert rig.sdo("80 0810 00 00000405") == ""
    assert code(rig.sdo("60")) == "05040001"


@pytest.mark.parametrize("segment", ["00", "60"])
def test_co_003_segment_without_initiate(rig: Rig, segment: str) -> None:
    assert rig.sdo(segment) == "8000000001000405"


def test_co_003_segment_of_the_other_direction_ends_the_transfer(rig: Rig) -> None:
    rig.sdo("40 0810 00")
    assert rig.sdo("00") == "8008100001000405"
    assert code(rig.sdo("60")) == "05040001"


@pytest.mark.parametrize("command", ["E0", "A1", "A2", "A3", "C1"])
def test_co_004_unknown_command_and_a_block_s_without_initiate(rig: Rig, command: str) -> None:
    assert code(rig.sdo(command + "0620 00")) == "05040001"


def test_co_005_a_new_initiate_starts_afresh(rig: Rig) -> None:
    rig.sdo("40 0810 00")
    rig.sdo("60")
    assert rig.sdo("40 0520 00") == "4105200008000000"
    assert rig.sdo("60") == "0088776655443322"
    assert rig.sdo("70") == "1D11000000000000"
    rig.sdo("21 0420 00 09000000")
    rig.sdo("00" + b"abcdefg".hex())
    assert rig.read(0x2006) == 7
    assert code(rig.sdo("1B" + b"hi".hex())) == "05040001", "the download was given up"
    assert rig.node.data.get(0x2004) == b"hello"


def test_co_006_write_to_read_only_is_refused_at_initiate(rig: Rig) -> None:
    assert rig.sdo("21 0810 00 20000000") == "8008100002000106"
    assert rig.write(0x2002, 0, 1, 2) == "06010002"


def test_co_007_read_of_write_only(rig: Rig) -> None:
    assert rig.read_code(0x2003) == "06010001"
    assert rig.write(0x2003, 0, 1, 4) == ""


@pytest.mark.parametrize(
    ("index", "sub", "expected"),
    [(0x3000, 0, "06020000"), (0x2006, 1, "06090011"), (0x2010, 3, "06090011"), (0x1800, 4, "06090011")],
)
def test_co_008_missing(rig: Rig, index: int, sub: int, expected: str) -> None:
    assert rig.read_code(index, sub) == expected
    assert rig.write(index, sub, 0, 1) == expected
    assert code(rig.sdo((b"\x21" + mux(index, sub) + b"\x20").hex())) == expected


def test_co_009_length(rig: Rig) -> None:
    assert rig.write(0x2006, 0, 1, 4) == "06070012"
    assert rig.write(0x2006, 0, 1, 1) == "06070013"
    assert code(rig.sdo("21 0520 00 09000000")) == "06070012", "announced, refused before any data"
    assert code(rig.sdo("21 0520 00 07000000")) == "06070013"


def test_co_010_limits(rig: Rig) -> None:
    assert rig.write(0x2000, 0, 101, 2) == "06090031"
    assert rig.write(0x2000, 0, -101, 2) == "06090032"
    assert rig.write(0x2000, 0, -100, 2) == ""
    assert rig.write(0x2007, 0, 2, 1) == "06090031", "a BOOLEAN is 0 or 1"
    assert code(rig.sdo("23 0820 00 0000C07F")) == "06090031", "not a number is inside no limits"


def test_co_011_history_takes_only_zero(rig: Rig) -> None:
    assert rig.write(0x1003, 0, 1, 1) == "06090030"
    assert rig.write(0x1003, 0, 0, 1) == ""


def test_co_012_empty_history(rig: Rig) -> None:
    assert rig.read_code(0x1003, 1) == "08000024"


def test_co_013_total_differs_from_the_announced_size(rig: Rig) -> None:
    rig.sdo("21 0420 00 08000000")
    rig.sdo("00" + b"abcdefg".hex())
    assert code(rig.sdo("1B" + b"hi".hex())) == "06070012"
    rig.sdo("21 0420 00 0A000000")
    rig.sdo("00" + b"abcdefg".hex())
    assert code(rig.sdo("1B" + b"hi".hex())) == "06070013"
    assert rig.node.data.get(0x2004) == b"hello"


def test_segments_without_announced_size_are_bounded_by_the_object(rig: Rig) -> None:
    rig.sdo("20 0520 00")
    rig.sdo("00" + bytes(7).hex())
    assert code(rig.sdo("10" + bytes(7).hex())) == "06070012"
    rig.sdo("20 0520 00")
    assert code(rig.sdo("01" + bytes(7).hex())) == "06070013"


def test_a_value_longer_than_memory(rig: Rig) -> None:
    assert code(rig.sdo("21 0920 00 FFFFFFFF")) == "05040005"


def test_co_022_server_timeout_restarts_at_each_segment(rig: Rig) -> None:
    rig.sdo("40 0810 00")
    assert rig.advance(900) == []
    rig.sdo("60")
    assert rig.advance(900) == []
    assert rig.advance(100) == [(100.0, f"{0x580 + NODE:03X}#8008100000000405")]
    assert rig.advance(10_000) == []
    counters = rig.node.counters
    assert (counters.sdo_requests, counters.sdo_replies, counters.sdo_aborts) == (2, 2, 1)


def test_co_024_a_stale_timeout_leaves_the_next_transfer_alone(rig: Rig) -> None:
    rig.sdo("40 0810 00")
    rig.advance(600)
    rig.sdo("40 0810 00")
    assert rig.advance(600) == []
    assert rig.sdo("60").startswith("00")


@pytest.mark.parametrize("data", ["", "40", "40062000", "400620000000 00"])
def test_co_026_short_request(rig: Rig, data: str) -> None:
    assert rig.send(0x600 + NODE, data) == []
    assert rig.node.counters.ignored == 1
    tolerant = Rig(RICH, NodeContext(tolerate_short_sdo=True))
    assert bool(tolerant.send(0x600 + NODE, data)) == bool(data)


def test_co_027_reset_during_a_transfer(rig: Rig) -> None:
    rig.sdo("40 0810 00")
    assert rig.nmt(129) == ["705#00"]
    assert rig.advance(5000) == []
    assert code(rig.sdo("60")) == "05040001"


def test_co_028_stopped(rig: Rig) -> None:
    rig.sdo("40 0810 00")
    rig.nmt(2)
    assert rig.sdo("40 0620 00") == ""
    assert rig.advance(5000) == []
    rig.nmt(128)
    assert code(rig.sdo("60")) == "05040001", "STOPPED ends a transfer"


def test_co_029_expedited_without_size(rig: Rig) -> None:
    assert rig.sdo("22 0620 00 3412FFFF") == "6006200000000000"
    assert rig.read(0x2006) == 0x1234
    assert code(rig.sdo("22 0520 00 01020304")) == "06070013"


def test_co_030_size_zero(rig: Rig) -> None:
    assert rig.sdo("21 0420 00 00000000").startswith("60")
    assert rig.sdo("0F") == "2000000000000000"
    assert rig.node.data.get(0x2004) == b""
    assert rig.sdo("40 0420 00") == "4104200000000000"
    assert rig.sdo("60") == "0F00000000000000"
    assert code(rig.sdo("21 0620 00 00000000")) == "06070013"


def test_co_031_store_and_restore(rig: Rig) -> None:
    save, load = int.from_bytes(b"save", "little"), int.from_bytes(b"load", "little")
    rig.write(0x2006, 0, 99, 2)
    rig.write(0x1017, 0, 250, 2)
    assert rig.write(0x1010, 1, load, 4) == "08000020"
    assert rig.write(0x1010, 3, save, 4) == ""
    assert rig.read(0x1010, 3) == 1, "the signature is not read back"
    rig.nmt(129)
    assert (rig.read(0x2006), rig.read(0x1017)) == (99, 0), "3 is the application's parameters only"
    assert rig.write(0x1011, 1, save, 4) == "08000020"
    assert rig.write(0x1011, 1, load, 4) == ""
    assert rig.read(0x2006) == 99, "takes effect after reset"
    rig.nmt(129)
    assert rig.read(0x2006) == 7


def test_every_request_is_counted_with_its_reply(rig: Rig) -> None:
    for request in ("40 0810 00", "60", "60", "40 0030 00", "80 0810 00 00000405", "2B 0620 00 01"):
        rig.sdo(request)
    counters = rig.node.counters
    assert (counters.sdo_requests, counters.sdo_replies, counters.sdo_aborts) == (5, 5, 2)


class AnyClient(RuleBasedStateMachine):
    """For any requests in any order: one reply or none, as the state requires, and a valid value afterwards."""

    def __init__(self) -> None:
        super().__init__()
        self.rig = Rig()
        self.state = NmtState.PRE_OPERATIONAL

    @rule(data=st.binary(min_size=8, max_size=8))
    def anything(self, data: bytes) -> None:
        self.exchange(data)

    @rule(
        command=st.sampled_from([0x40, 0x20, 0x21, 0x22, 0x23, 0x2B, 0x2F, 0xE0]),
        key=st.sampled_from(
            [(0x1008, 0), (0x2004, 0), (0x2005, 0), (0x2006, 0), (0x2009, 0), (0x1003, 1), (0x3000, 0)]
        ),
        rest=st.binary(min_size=4, max_size=4),
    )
    def initiate(self, command: int, key: tuple[int, int], rest: bytes) -> None:
        self.exchange(bytes([command]) + mux(*key) + rest)

    @rule(command=st.integers(0, 0x1F), rest=st.binary(min_size=7, max_size=7))
    def download_segment(self, command: int, rest: bytes) -> None:
        self.exchange(bytes([command]) + rest)

    @rule(toggle=st.sampled_from([0x60, 0x70]))
    def upload_segment(self, toggle: int) -> None:
        self.exchange(bytes([toggle]) + bytes(7))

    @rule()
    def client_abort(self) -> None:
        self.exchange(bytes.fromhex("8000000000000405"))

    @rule(data=st.binary(max_size=7))
    def too_short(self, data: bytes) -> None:
        assert self.rig.send(0x600 + NODE, data.hex()) == []

    @rule(ms=st.integers(0, 1500))
    def wait(self, ms: int) -> None:
        for _, frame in self.rig.advance(ms):
            assert not frame.startswith("585#") or frame.endswith("00000405"), frame

    @rule(command=st.sampled_from([(2, NmtState.STOPPED), (128, NmtState.PRE_OPERATIONAL), (129, None)]))
    def nmt(self, command: tuple[int, NmtState | None]) -> None:
        frames = self.rig.nmt(command[0])
        assert ("705#00" in frames) == (command[1] is None)
        self.state = command[1] or NmtState.PRE_OPERATIONAL

    def exchange(self, data: bytes) -> None:
        reply, _ = self.rig.sdo_and_more(data.hex())
        silent = self.state is NmtState.STOPPED or data[0] >> 5 == 4
        assert (reply == "") == silent, (data.hex(), reply)

    @invariant()
    def a_plain_read_always_works(self) -> None:
        """It never hangs. This request is answered in every state; it also ends any current transfer."""
        if self.state is not NmtState.STOPPED and self.rig.node.counters.sdo_requests % 5 == 0:
            assert self.rig.sdo("40 0010 00") == "4300100000000000"

    @invariant()
    def books_balance(self) -> None:
        counters = self.rig.node.counters
        assert counters.sdo_requests == counters.sdo_replies
        assert self.rig.node.data.get(0x1008) == NAME


AnyClient.TestCase.settings = settings(max_examples=60, stateful_step_count=40, deadline=None)
test_any_client = AnyClient.TestCase
