"""The SDO server with any client on any wire: it always holds a value that some client wrote completely, and it always
recovers."""

from __future__ import annotations

from binascii import crc_hqx

from canopen_slave_rig import RICH, Rig, mux
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from fieldtwin.emulators.canopen.node import NodeContext

BLOB, NAME = 0x2009, 0x1008
BLOCK = 5


class Chaos(RuleBasedStateMachine):
    """A client that downloads and uploads in all ways, over a wire that loses, doubles and reorders, and that stops at any
    time.

    Values carry their length and checksum, so a value combined from two transfers is detected at once.
    """

    def __init__(self) -> None:
        super().__init__()
        self.rig = Rig(RICH, NodeContext(sdo_block=BLOCK))
        self.complete = {b""}  # all values that a client ever started to write
        self.frames: list[bytes] = []  # data that the client of the present download still has to send
        self.serial = 0

    def request(self, data: bytes) -> list[bytes]:
        sent = self.rig.send(0x600 + self.rig.node_id, data.ljust(8, b"\0").hex())
        return [bytes.fromhex(frame.partition("#")[2]) for frame in sent]

    def value(self, size: int) -> bytes:
        self.serial += 1
        return bytes((self.serial + 31 * i) & 0xFF for i in range(size))

    @rule(size=st.integers(5, 80))
    def begin_segmented_download(self, size: int) -> None:
        self.begin(size, b"\x21", segmented)

    @rule(size=st.integers(0, 80))
    def begin_block_download(self, size: int) -> None:
        self.begin(size, b"\xc6", blocks)

    def begin(self, size: int, command: bytes, cut: object) -> None:
        value = self.value(size)
        self.complete.add(value)
        assert callable(cut)
        self.frames = cut(value)
        self.request(command + mux(BLOB, 0) + size.to_bytes(4, "little"))

    @precondition(lambda self: self.frames)
    @rule(loss=st.sampled_from(["no", "no", "no", "no", "lost", "doubled", "late"]))
    def next_frame(self, loss: str) -> None:
        frame = self.frames.pop(0)
        if loss == "late" and self.frames:
            self.frames.insert(1, frame)
            return
        for _ in range({"no": 1, "late": 1, "lost": 0, "doubled": 2}[loss]):
            self.request(frame)

    @rule(count=st.integers(1, 12))
    def many_frames(self, count: int) -> None:
        for frame in self.frames[:count]:
            self.request(frame)
        del self.frames[:count]

    @rule()
    def client_abort(self) -> None:
        self.request(bytes.fromhex("8009200000000405"))

    @rule(ms=st.sampled_from([10, 499, 500, 999, 1000]))
    def silence(self, ms: int) -> None:
        for _, frame in self.rig.advance(ms):
            assert frame.startswith(("585#A2", "585#80")), frame

    @rule(block=st.integers(1, BLOCK), acknowledged=st.lists(st.integers(0, BLOCK), min_size=1, max_size=30))
    def block_upload(self, block: int, acknowledged: list[int]) -> None:
        """A client that loses segments of every sub-block, and gives up after a number of attempts."""
        answer = self.request(b"\xa4" + mux(NAME, 0) + bytes([block, 0]))
        if not answer or answer[0][0] != 0xC6:
            return  # treated as a segment of the current download
        got, sent = b"", self.request(b"\xa3")
        for number in acknowledged:
            good = min(number, len(sent))
            got += b"".join(frame[1:] for frame in sent[:good])
            sent = self.request(bytes([0xA2, good, block]))
            if sent[0][0] & 0xE3 == 0xC1:
                size = len(got) - (sent[0][0] >> 2 & 7)
                assert got[:size] == b"a node for tests"
                assert crc_hqx(got[:size], 0) == int.from_bytes(sent[0][1:3], "little")
                assert self.request(b"\xa1") == []
                return
            assert len(sent) <= block

    @invariant()
    def only_whole_values(self) -> None:
        assert self.rig.node.data.get(BLOB) in self.complete

    def teardown(self) -> None:
        """It never hangs: after a second of silence the node is in its initial state."""
        self.rig.advance(1000)
        assert self.rig.read(0x1000) == 0
        value = self.value(30)
        self.complete.add(value)
        self.frames = blocks(value)
        self.request(b"\xc6" + mux(BLOB, 0) + len(value).to_bytes(4, "little"))
        replies = [self.request(frame) for frame in self.frames]
        assert replies[-1] == [b"\xa1" + bytes(7)]
        assert self.rig.node.data.get(BLOB) == value


def segmented(value: bytes) -> list[bytes]:
    chunks = [value[i : i + 7] for i in range(0, len(value), 7)]
    last = len(chunks) - 1
    return [bytes([n % 2 << 4 | (7 - len(c)) << 1 | (n == last)]) + c for n, c in enumerate(chunks)]


def blocks(value: bytes) -> list[bytes]:
    """Segments in sub-blocks of the server's size, and the end request."""
    chunks = [value[i : i + 7] for i in range(0, len(value), 7)] or [b""]
    last = len(chunks) - 1
    frames = [bytes([n % BLOCK + 1 | (0x80 if n == last else 0)]) + c for n, c in enumerate(chunks)]
    end = bytes([0xC1 | (7 - len(chunks[-1])) << 2]) + crc_hqx(value, 0).to_bytes(2, "little")
    return [*frames, end]


Chaos.TestCase.settings = settings(max_examples=40, stateful_step_count=40, deadline=None)
test_chaos = Chaos.TestCase


@given(value=st.binary(max_size=400), lost=st.sets(st.integers(0, 120), max_size=60), block=st.integers(1, 127))
@settings(max_examples=60, deadline=None)
def test_a_block_download_arrives_whatever_is_lost(value: bytes, lost: set[int], block: int) -> None:
    """A correct client whose n-th segment is lost for each n in `lost`; the acknowledgement tells which segments to repeat."""
    rig = Rig(RICH, NodeContext(sdo_block=block))
    head = 0x600 + rig.node_id
    rig.send(head, (b"\xc6" + mux(BLOB, 0) + len(value).to_bytes(4, "little")).hex())
    chunks = [value[i : i + 7] for i in range(0, len(value), 7)] or [b""]
    offset = counted = 0
    while offset < len(chunks):
        answer: list[str] = []
        for number, chunk in enumerate(chunks[offset : offset + block], start=1):
            last = 0x80 if offset + number == len(chunks) else 0
            counted += 1
            if counted not in lost:
                answer = rig.send(head, (bytes([number | last]) + chunk).ljust(8, b"\0").hex())
        answer = answer or [frame for _, frame in rig.advance(500)]
        assert len(answer) == 1
        if answer == [f"585#80{mux(BLOB, 0).hex()}00000405"]:
            return  # a second without a received frame ends any transfer
        assert answer[0].startswith("585#A2")
        offset += int(answer[0][6:8], 16)
    end = bytes([0xC1 | (7 - len(chunks[-1])) << 2]) + crc_hqx(value, 0).to_bytes(2, "little")
    assert rig.send(head, end.ljust(8, b"\0").hex()) == ["585#A1" + "00" * 7]
    assert rig.node.data.get(BLOB) == value
