"""The correct CANopen nodes, from whose replies the hostile node derives its own. Every object exists and reads as the same
test value (a word), except for a few fixed objects; every node has an SDO server.

The module does no I/O and reads no clock: its functions receive frames and the present time, and return frames. The first
request or command to a node ID creates the node.
"""

from __future__ import annotations

from fieldtwin.emulators.canopen.sdo.server import SdoServer

TIMEOUT_NS = 2_000_000_000
LONG_BYTES = 1000
"""Length in bytes of the value of a block upload: the word is repeated to fill it. It needs two sub-blocks."""
BOOT_UP, PRE_OPERATIONAL, OPERATIONAL, STOPPED = 0x00, 0x7F, 0x05, 0x04
_STATES = {0x01: OPERATIONAL, 0x02: STOPPED, 0x80: PRE_OPERATIONAL}
_RESETS = frozenset({0x81, 0x82})
_FIXED = {(0x1001, 0): b"\0", (0x1008, 0): b"fieldtwin", (0x1018, 0): b"\x04"}


class OneWordObjects:
    """Objects that all read as `word` in `size` bytes, little-endian; a written object reads back its value."""

    def __init__(self, word: int, size: int, held: dict[tuple[int, int], bytes]) -> None:
        self.word = word
        self.long = False
        self._size = size
        self._written = {**_FIXED, **held}

    def read(self, index: int, subindex: int, now_ns: int) -> bytes:
        raw = self._written.get((index, subindex))
        if raw is not None:
            return raw
        word = self.word.to_bytes(self._size, "little")
        return word * (LONG_BYTES // self._size) if self.long else word

    def begin_write(self, index: int, subindex: int, size: int | None) -> int | None:
        return None

    def write(self, index: int, subindex: int, raw: bytes, now_ns: int) -> None:
        self._written[index, subindex] = raw


class HonestNode:
    """One node: its SDO server and its NMT state."""

    def __init__(self, word: int, size: int, held: dict[tuple[int, int], bytes]) -> None:
        self.objects = OneWordObjects(word, size, held)
        self.state = PRE_OPERATIONAL
        self._size = size
        self._server = SdoServer(self.objects, TIMEOUT_NS)

    def answer(self, request: bytes, now_ns: int) -> list[bytes]:
        """Return the SDO replies to a request: several frames for a sub-block of a block upload, none while the node is
        STOPPED.
        """
        if self.state == STOPPED:
            return []
        self.objects.long = request[0] >> 5 == 5
        return self._server.request(request, now_ns)

    def acknowledge(self, now_ns: int) -> list[bytes]:
        """Return the acknowledgement of the segments received so far, before the sub-block of a block download is complete."""
        return self._server.tick(now_ns + TIMEOUT_NS // 2)

    @property
    def receiving(self) -> bool:
        """Return whether a sub-block of a block download is in progress, so that every SDO frame is a segment of it."""
        return self._server.in_sub_block

    def poisoned(self, request: bytes, poison: int) -> bytes:
        """Return an expedited upload response whose value is `poison` instead of the object's value."""
        return (
            bytes((0x43 | (4 - self._size) << 2,))
            + request[1:4]
            + poison.to_bytes(self._size, "little").ljust(4, b"\0")
        )

    def command(self, specifier: int) -> bool:
        """Execute the NMT command `specifier`; return True if the node then has to send a boot-up message."""
        if specifier in _RESETS:
            self.state = PRE_OPERATIONAL
            self._server.reset()
            return True
        self.state = _STATES.get(specifier, self.state)
        return False
