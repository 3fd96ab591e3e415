"""Decode the SDO transfers of one node as a passive listener (CiA 301, 7.2.4.3).

It decodes expedited, segmented and block transfers, uploads and downloads. The first eight bits of a frame identify it,
except inside a block, where they number its segments: therefore the state is tracked. Other frames are strays. The module
does no I/O and stores one open transfer.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from fieldtwin.gateway.protocols.canopen.sdo.abort_codes import meaning

MAX_BYTES = 1 << 20
"""Maximum number of bytes that are kept of one object's value."""

_ABORT = 0x80


@dataclass(slots=True)
class Transfer:
    """A transfer, as far as it is known. `data` is complete when the transfer has ended; `aborted_by` is client or server."""

    upload: bool
    index: int
    subindex: int
    t_ns: int
    request: bytes
    data: bytearray = field(default_factory=bytearray)
    reply: bytes = b""
    block: bool = False
    abort: int | None = None
    aborted_by: str = ""
    answered: bool = False
    segments: dict[int, bytes] = field(default_factory=dict)
    """The segments of the current sub-block that are not acknowledged yet."""
    in_segments: bool = False
    last: int = 0
    """The number of the sub-block's last segment, if that segment ends the transfer; else 0."""
    last_sent: bool = False
    """True when the client of a segmented download has sent its last segment."""

    @property
    def name(self) -> str:
        return f"{self.index:04X}h:{self.subindex:02X}"

    @property
    def service(self) -> str:
        return "SDO upload" if self.upload else "SDO download"


@dataclass(frozen=True, slots=True)
class Seen:
    """The meaning of a frame.

    `done` is the transfer that the frame ended, and `dropped` the transfer that it left without an answer by beginning a new one.
    `stray`: a frame of the server that answers no request.
    """

    text: str
    done: Transfer | None = None
    dropped: Transfer | None = None
    stray: bool = False


class SdoWatch:
    """The decoder of a node's SDO transfers. It is given the data of each frame on the node's two SDO identifiers, in order."""

    def __init__(self) -> None:
        self.open: Transfer | None = None

    def drop(self) -> Transfer | None:
        """Return the transfer that is still open at the end of the trace, as unanswered."""
        now, self.open = self.open, None
        return now

    def request(self, data: bytes, t_ns: int) -> Seen:
        """Decode a frame of the client."""
        if len(data) < 8:
            return Seen(f"an SDO request of {len(data)} bytes")
        first, kind, now = data[0], data[0] >> 5, self.open
        if first == _ABORT:
            return self._aborted(data, "client")
        if now is not None and now.in_segments and not now.upload:
            return _segment_of_block(now, data)
        if kind in (1, 2) or (kind == 5 and first & 3 == 0) or (kind == 6 and first & 1 == 0):
            return self._begin(data, kind, t_ns)
        if now is None:
            return Seen("an SDO request that belongs to no transfer")
        if kind == 0 and not now.upload:
            _keep(now, data[1 : 8 - (first >> 1 & 7)])
            now.last_sent = bool(first & 1)
            return Seen(f"{now.name}: segment" + (", the last" if now.last_sent else ""))
        if kind == 3 and now.upload:
            return Seen(f"{now.name}: the next segment")
        if kind == 5 and now.block:
            return self._block_upload_goes_on(now, data)
        if kind == 6 and now.block:
            _trim(now, first >> 2 & 7)
            return Seen(f"{now.name}: end of the blocks")
        return Seen("an SDO request that does not fit its transfer")

    def reply(self, data: bytes, t_ns: int) -> Seen:
        """Decode a frame of the server."""
        now = self.open
        if len(data) < 4:
            return Seen(f"an SDO reply of {len(data)} byte{'s' * (len(data) != 1)}", stray=True)
        if data[0] == _ABORT:
            return self._aborted(data, "server")
        if now is None:
            return Seen("an SDO reply without a request", stray=True)
        first, kind, ours = data[0], data[0] >> 5, data[1:4] == now.request[1:4]
        if now.in_segments and now.upload:
            return _segment_of_block(now, data)
        now.reply = data
        if kind == 2 and now.upload and ours:
            return self._upload_reply(now, data)
        if kind == 3 and not now.upload and ours:
            now.answered = True
            return self._over(now) if now.request[0] & 2 else Seen(f"{now.name}: go on")
        if kind == 1 and not now.upload and now.answered:
            return self._over(now) if now.last_sent else Seen(f"{now.name}: segment taken")
        if kind == 0 and now.upload and now.answered:
            _keep(now, data[1 : 8 - (first >> 1 & 7)])
            return self._over(now) if first & 1 else Seen(f"{now.name}: segment")
        if now.block and kind == (6 if now.upload else 5):
            return self._block_reply(now, data, ours)
        return Seen("an SDO reply to another request", stray=True)

    def _begin(self, data: bytes, kind: int, t_ns: int) -> Seen:
        dropped = self.drop()
        now = Transfer(kind in (2, 5), int.from_bytes(data[1:3], "little"), data[3], t_ns, data, block=kind in (5, 6))
        self.open = now
        if kind == 1 and data[0] & 2:
            _keep(now, _expedited(data))
        return Seen(f"{now.service} {now.name}" + (" in blocks" if now.block else ""), dropped=dropped)

    def _upload_reply(self, now: Transfer, data: bytes) -> Seen:
        now.answered, now.block = True, False  # a node may answer a block upload with an ordinary upload
        if data[0] & 2:
            _keep(now, _expedited(data))
            return self._over(now)
        size = f"{int.from_bytes(data[4:8], 'little')} bytes" if data[0] & 1 else "some bytes"
        return Seen(f"{now.name}: {size} in segments")

    def _block_upload_goes_on(self, now: Transfer, data: bytes) -> Seen:
        match data[0] & 3:
            case 3:
                now.in_segments = True
                return Seen(f"{now.name}: begin")
            case 2:
                _acknowledge(now, data[1])
                return Seen(f"{now.name}: {data[1]} segments taken")
        return self._over(now)

    def _block_reply(self, now: Transfer, data: bytes, ours: bool) -> Seen:
        if now.upload and not data[0] & 1 and ours:
            now.answered = True
            return Seen(f"{now.name}: blocks of {now.request[4]}")
        if now.upload:
            _trim(now, data[0] >> 2 & 7)
            return Seen(f"{now.name}: end of the blocks")
        if data[0] & 3 == 0 and ours:
            now.answered = now.in_segments = True
            return Seen(f"{now.name}: blocks of {data[4] if len(data) > 4 else '?'}")
        if data[0] & 3 == 2:
            _acknowledge(now, data[1])
            return Seen(f"{now.name}: {data[1]} segments taken")
        return self._over(now)

    def _over(self, now: Transfer) -> Seen:
        self.open = None
        return Seen("", done=now)

    def _aborted(self, data: bytes, by: str) -> Seen:
        code, now = int.from_bytes(data[4:8], "little"), self.open
        unnamed = by == "client" and data[1:4] == bytes(3)  # canopen-python leaves the multiplexer 0
        if now is None or not (unnamed or data[1:4] == now.request[1:4]):
            return Seen(f"abort {code:08X}h {meaning(code)}, of no transfer", stray=by == "server")
        now.abort, now.aborted_by, now.reply = code, by, data
        return self._over(now)


def _expedited(data: bytes) -> bytes:
    return data[4 : 8 - (data[0] >> 2 & 3 if data[0] & 1 else 0)]


def _keep(now: Transfer, data: bytes) -> None:
    if len(now.data) < MAX_BYTES:
        now.data += data


def _trim(now: Transfer, unused: int) -> None:
    if unused:
        del now.data[max(0, len(now.data) - unused) :]


def _segment_of_block(now: Transfer, data: bytes) -> Seen:
    number = data[0] & 0x7F
    now.segments[number] = data[1:]
    if data[0] & 0x80:
        now.last = number
    return Seen(f"{now.name}: segment {number} of a block" + (", the last" if data[0] & 0x80 else ""))


def _acknowledge(now: Transfer, upto: int) -> None:
    """Accept the segments 1 to `upto`; the client repeats the rest, numbered from 1."""
    for number in range(1, upto + 1):
        _keep(now, now.segments.get(number, b""))
    if upto and upto == now.last:
        now.in_segments = False
    now.segments.clear()
    now.last = 0
