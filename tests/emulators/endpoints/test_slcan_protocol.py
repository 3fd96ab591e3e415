"""The adapter's side of slcan, byte for byte: commands of LAWICEL's manual, and arbitrary other input."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldtwin.emulators.endpoints.can.slcan_protocol import MAX_LINE, SlcanSession
from fieldtwin.gateway.core.can_error import CanErrorState, overrun_frame, state_frame, violation_frame
from fieldtwin.gateway.core.canframe import CanFrame

BEL = b"\a"


class Adapter:
    """A session on a bus of 125 kbit/s that accepts sent frames, up to `room` of them."""

    def __init__(self, opened: bool = True, room: int = 1000) -> None:
        self.session = SlcanSession(125_000)
        self.sent: list[str] = []
        self.room = room
        if opened:
            assert self.say(b"O\r") == b"\r"

    def say(self, data: bytes) -> bytes:
        self.session.feed(data)
        return self.go_on()

    def go_on(self) -> bytes:
        answers = b""
        while (answer := self.session.step(self._send)) is not None:
            answers += answer
        return answers

    def _send(self, frame: CanFrame) -> bool:
        if len(self.sent) >= self.room:
            return False
        self.sent.append(str(frame))
        return True


@pytest.mark.parametrize(
    ("command", "answer", "frame"),
    [
        (b"t1230\r", b"z\r", "123#"),
        (b"t7FF8001122334455667f\r", b"z\r", "7FF#001122334455667F"),
        (b"T000001231AB\r", b"Z\r", "00000123#AB"),
        (b"T1FFFFFFF0\r", b"Z\r", "1FFFFFFF#"),
        (b"r6058\r", b"z\r", "605#R8"),
        (b"R000006050\r", b"Z\r", "00000605#R"),
        (b"t1231AA1234\r", b"z\r", "123#AA"),  # a time stamp along with it
        (b"t8000\r", BEL, None),  # not an 11-bit identifier
        (b"T200000000\r", BEL, None),
        (b"t1239001122334455667788\r", BEL, None),  # an invalid length code
        (b"t1232AA\r", BEL, None),
        (b"t1231AAA\r", BEL, None),
        (b"t12\r", BEL, None),
        (b"t123\r", BEL, None),
        (b"t12x0\r", BEL, None),
        (b"r1231AA\r", BEL, None),
        (b"d1230\r", BEL, None),  # CAN FD
        (b"V\r", b"V1013\r", None),
        (b"N\r", b"NFT01\r", None),
        (b"F\r", b"F00\r", None),
        (b"\r\r\r", b"\r\r\r", None),
        (b"\nV\r", b"V1013\r", None),
        (b"X1\r", b"\r", None),
        (b"M00000000\r", b"\r", None),
        (b"mFFFFFFFF\r", b"\r", None),
        (b"M00000001\r", BEL, None),  # a filter, which is not supported
        (b"S4\r", BEL, None),  # while open
        (b"O\r", BEL, None),
        (b"?\r", BEL, None),
        (b"t" * 5000 + b"\rV\r", BEL + b"V1013\r", None),
        (b"V" + b"\xff" * 40 + b"\r", BEL, None),
    ],
)
def test_commands_while_open(command: bytes, answer: bytes, frame: str | None) -> None:
    whole, split = Adapter(), Adapter()
    assert whole.say(command) == answer
    assert b"".join(split.say(bytes([byte])) for byte in command) == answer
    assert whole.sent == split.sent == ([frame] if frame else [])
    assert whole.session.refused == (answer.count(BEL))


@pytest.mark.parametrize(
    ("commands", "answer"),
    [
        (b"S4\r", b"\r"),  # 125 kbit/s, the bus's
        (b"S6\r", BEL),
        (b"S\r", BEL),
        (b"S44\r", BEL),
        (b"s031C\r", b"\r"),  # BTR0 03h, BTR1 1Ch: 8 MHz / (4 * 16)
        (b"s001C\r", BEL),
        (b"s03\r", BEL),
        (b"t1230\r", BEL),  # closed
        (b"F\r", BEL),
        (b"C\r", b"\r"),
        (b"L\rt1230\r", b"\r" + BEL),  # listen-only
        (b"L\rC\rO\rt1230\r", b"\r\r\rz\r"),
        (b"Z1\r", b"\r"),
        (b"Z2\r", BEL),
    ],
)
def test_commands_while_closed(commands: bytes, answer: bytes) -> None:
    assert Adapter(opened=False).say(commands) == answer


def test_received_frames_are_sent_to_the_client() -> None:
    adapter = Adapter(opened=False)
    frame = CanFrame(0x185, b"\x01\xab", t_ns=61_234 * 10**6)
    assert adapter.session.received(frame) == b""
    adapter.say(b"O\r")
    assert adapter.session.received(frame) == b"t185201AB\r"
    assert adapter.session.received(CanFrame(0x5, remote=True, extended=True, dlc=3)) == b"R000000053\r"
    adapter.say(b"Z1\r")
    assert adapter.session.received(frame) == b"t185201AB04D2\r"  # 1234 ms of the minute


def test_status_flags_report_overruns_errors_and_states() -> None:
    adapter = Adapter()
    adapter.session.controller(overrun_frame())
    adapter.session.controller(violation_frame("bit", 8, 0))
    assert adapter.say(b"F\rF\r") == b"F89\rF00\r"  # reported once
    for state, flags in zip(CanErrorState, (b"F00\r", b"F04\r", b"F24\r", b"FA4\r"), strict=True):
        adapter.session.controller(state_frame(state, 128, 0))
        assert adapter.say(b"F\rF\r") == 2 * flags  # a state lasts


def test_a_full_queue_delays_the_command() -> None:
    adapter = Adapter(room=1)
    assert adapter.say(b"t1000\rt2000\rV\r") == b"z\r"
    assert adapter.session.waiting
    assert adapter.go_on() == b""
    adapter.room = 2
    assert adapter.go_on() == b"z\rV1013\r"
    assert not adapter.session.waiting
    assert adapter.sent == ["100#", "200#"]
    assert adapter.say(b"F\r") == b"F02\r"


@given(
    st.lists(
        st.binary(max_size=60) | st.sampled_from([b"t1230\r", b"O\r", b"C\r", b"T12345678812345678\r"]), max_size=20
    )
)
def test_any_bytes_are_answered_line_by_line(chunks: list[bytes]) -> None:
    adapter = Adapter()
    answers = b"".join(adapter.say(chunk) for chunk in chunks)
    text = b"".join(chunks)
    assert answers.count(b"\r") + answers.count(BEL) == text.count(b"\r")
    assert len(adapter.session._buffer) <= MAX_LINE
    adapter.say(b"\rC\rO\r")
    assert adapter.say(b"t1230\r") == b"z\r"


@given(st.integers(0, 0x1FFFFFFF), st.binary(max_size=8), st.booleans(), st.booleans())
def test_each_side_can_send_the_messages_of_the_other(can_id: int, data: bytes, extended: bool, remote: bool) -> None:
    can_id = can_id if extended else can_id & 0x7FF
    frame = CanFrame(can_id, b"" if remote else data, extended=extended, remote=remote, dlc=len(data))
    one, other = Adapter(), Adapter()
    assert other.say(one.session.received(frame)) in (b"z\r", b"Z\r")
    assert other.sent == [str(frame)]
