"""The possible lengths of any RTU frame, which are needed to skip a frame that is not the awaited reply.

A serial line carries the frames of every unit, and also requests of other clients. Only the function code and the byte count
determine where a frame ends (AP 6). This module uses the first bytes of a frame and no check sums.
"""

from __future__ import annotations

MAX_FRAME = 256
"""The number of bytes of the longest RTU frame (SL 2.5.1)."""

MIN_FRAME = 4
"""The number of bytes of the shortest frame: unit ID, function and check sum."""

_FIXED: dict[int, tuple[int, ...]] = {
    0x01: (8,),
    0x02: (8,),
    0x03: (8,),
    0x04: (8,),
    0x05: (8,),
    0x06: (8,),
    0x07: (4, 5),
    0x08: (8,),
    0x0B: (4, 8),
    0x0C: (4,),
    0x0F: (8,),
    0x10: (8,),
    0x11: (4,),
    0x16: (10,),
    0x18: (6,),
    0x2B: (7,),
}
"""By function code: the lengths of requests and replies that only the function code determines."""

_COUNTED: dict[int, tuple[tuple[int, int], ...]] = {
    0x01: ((2, 5),),
    0x02: ((2, 5),),
    0x03: ((2, 5),),
    0x04: ((2, 5),),
    0x0C: ((2, 5),),
    0x0F: ((6, 9),),
    0x10: ((6, 9),),
    0x11: ((2, 5),),
    0x14: ((2, 5),),
    0x15: ((2, 5),),
    0x17: ((2, 5), (10, 13)),
}
"""By function code: the position of the byte count, and the length of the frame without the bytes that are counted."""

KNOWN_FUNCTIONS = frozenset(_FIXED.keys() | _COUNTED.keys())
"""Functions whose frames have a known length."""

_EVEN = frozenset({0x03, 0x04, 0x10, 0x17})

_FIFO = 0x18
_MEI = 0x2B
_DEVICE_IDENTIFICATION = 0x0E


def frame_lengths(head: bytes | bytearray) -> tuple[list[int], bool]:
    """Return the possible lengths of a frame that begins with `head`, ascending, and whether more bytes could add one.

    `head` holds at least two bytes (unit ID, function). ([], False) means that no known frame begins like this.
    """
    function = head[1]
    if function & 0x80:
        return ([5], False) if function & 0x7F else ([], False)
    lengths = set(_FIXED.get(function, ()))
    open_ended = False
    for at, rest in _COUNTED.get(function, ()):
        if len(head) <= at:
            open_ended = True
        elif head[at] and rest + head[at] <= MAX_FRAME and not (function in _EVEN and head[at] % 2):
            lengths.add(rest + head[at])
    if function in (_FIFO, _MEI):
        special, more = _fifo_reply(head) if function == _FIFO else _identification_reply(head)
        lengths.update(special)
        open_ended = more
    return sorted(lengths), open_ended


def _fifo_reply(head: bytes | bytearray) -> tuple[list[int], bool]:
    """Return the lengths of a FIFO reply, whose byte count has two bytes (AP 6.18)."""
    if len(head) < 4:
        return [], True
    length = 6 + int.from_bytes(head[2:4], "big")
    return ([length], False) if 8 <= length <= MAX_FRAME and length % 2 == 0 else ([], False)


def _identification_reply(head: bytes | bytearray) -> tuple[list[int], bool]:
    """Return the lengths of an identification reply (AP 6.21): eight bytes, then as many objects as the eighth byte
    says.

    Each object has its own length.
    """
    if len(head) > 2 and head[2] != _DEVICE_IDENTIFICATION:
        return [], False
    if len(head) < 8:
        return [], True
    end = 8
    for _ in range(head[7]):
        if end + 2 > len(head):
            return [], end + 4 <= MAX_FRAME
        end += 2 + head[end + 1]
    return ([end + 2], False) if end + 2 <= MAX_FRAME else ([], False)
