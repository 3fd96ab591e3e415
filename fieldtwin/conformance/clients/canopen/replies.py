"""The replies of a hostile CANopen node (CiA 301 v4.2, 7.2.4 for SDO).

Each function takes a request (`SdoRequestContext`) and returns the frames to send. It does no I/O.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from fieldtwin.conformance.clients.canopen.setup import SdoReplyFunction, SdoRequestContext, SendFrame
from fieldtwin.gateway.core.canframe import CanFrame

HEARTBEAT, EMCY, TPDO1 = 0x700, 0x080, 0x180
PRE_OPERATIONAL = 0x7F
LATE = 1.5
STORM = range(100, 120)
SLOW = 0.35
"""Delay of each step of a slow transfer, as a fraction of the client's timeout. No single step exceeds the timeout, but all
steps together do.
"""


def nothing(scene: SdoRequestContext) -> list[SendFrame]:
    return []


def _segmented(scene: SdoRequestContext, segment: Callable[[int], bytes]) -> list[SendFrame]:
    """Reply with a segmented upload of 14 bytes; `segment` gives the reply to the n-th request after the first, from 1."""
    if scene.opens:
        scene.memory["segments"] = 0
        return [scene.reply(b"\x41" + scene.request[1:4] + (14).to_bytes(4, "little"))]
    if "segments" not in scene.memory:
        return scene.honest()
    scene.memory["segments"] += 1
    return [scene.reply(segment(scene.memory["segments"]))]


def same_toggle(scene: SdoRequestContext) -> list[SendFrame]:
    """Repeat the toggle bit of the first segment in the second segment of an upload."""
    return _segmented(scene, lambda n: bytes((0x01 if n > 1 else 0x00,)) + scene.poison.ljust(7, b"\0"))


def other_length(scene: SdoRequestContext) -> list[SendFrame]:
    """End a segmented upload before the indicated length."""
    return _segmented(scene, lambda n: bytes((0x01 | (7 - len(scene.poison)) << 1,)) + scene.poison.ljust(7, b"\0"))


def unknown_command(scene: SdoRequestContext) -> list[SendFrame]:
    return [scene.reply(b"\xe0" + scene.false[1:])] if scene.opens else scene.honest()


def other_object(scene: SdoRequestContext) -> list[SendFrame]:
    if not scene.opens:
        return scene.honest()
    return [scene.reply(scene.false[:1] + bytes((scene.false[1] ^ 0x01,)) + scene.false[2:])]


def no_object(scene: SdoRequestContext) -> list[SendFrame]:
    return [scene.reply(b"\x80" + scene.request[1:4] + (0x06020000).to_bytes(4, "little"))]


def wrong_crc(scene: SdoRequestContext) -> list[SendFrame]:
    """Block upload: send a wrong check sum in the end frame."""
    if len(scene.true) == 1 and scene.true[0][0] & 0xE3 == 0xC1:
        end = scene.true[0]
        return [scene.reply(end[:1] + bytes((end[1] ^ 0xFF,)) + end[2:])]
    return [scene.reply(data) for data in scene.true]


def loses(at: int) -> SdoReplyFunction:
    """Return a reply function that omits one segment of a block upload once. A positive index `at` (from 0) omits it from a
    full sub-block, a negative one, counted from the end, from a shorter last sub-block.
    """

    def play(scene: SdoRequestContext) -> list[SendFrame]:
        frames = [scene.reply(data) for data in scene.true]
        full = len(frames) == 127
        if len(frames) < 3 or (at > 0) != full or scene.memory.get("lost"):
            return frames
        scene.memory["lost"] = 1
        del frames[at]
        return frames

    return play


def expedited_instead(scene: SdoRequestContext) -> list[SendFrame]:
    """Answer a block upload with an ordinary upload, as the client's protocol switch threshold (pst) allows."""
    if not scene.opens:
        return scene.honest()
    size = len(scene.poison)
    word = scene.memory["word"].to_bytes(size, "little").ljust(4, b"\0")
    return [scene.reply(bytes((0x43 | (4 - size) << 2,)) + scene.request[1:4] + word)]


def late(scene: SdoRequestContext) -> list[SendFrame]:
    return [scene.reply(scene.false, LATE * scene.timeout_s)]


def flood(scene: SdoRequestContext) -> list[SendFrame]:
    junk = [scene.reply(bytes((0xE0 + i % 32,)) + bytes(7)) for i in range(30)]
    return [*junk, *scene.honest(0.010)] if scene.opens else scene.honest()


def short(scene: SdoRequestContext) -> list[SendFrame]:
    """Send a reply shorter than 8 bytes: without its unused bytes, or without its last byte if all are used."""
    if not scene.opens:
        return scene.honest()
    used = 4 + (4 - (scene.true[0][0] >> 2 & 3))
    return [scene.reply(scene.true[0][: min(used, 7)])]


def restarts(scene: SdoRequestContext) -> list[SendFrame]:
    return [replace(scene.frame(HEARTBEAT, b"\0"), after_s=0.050)]


def boots(scene: SdoRequestContext) -> list[SendFrame]:
    return [*scene.honest(), replace(scene.frame(HEARTBEAT, b"\0"), after_s=0.010)]


def no_size(scene: SdoRequestContext) -> list[SendFrame]:
    return [scene.reply(b"\x42" + scene.true[0][1:])] if scene.opens else scene.honest()


def heartbeat(data: bytes) -> SdoReplyFunction:
    return lambda scene: [scene.frame(HEARTBEAT, data), *scene.honest()]


def twin(scene: SdoRequestContext) -> list[SendFrame]:
    return [*scene.honest(), scene.reply(scene.false, 0.003)] if scene.opens else scene.honest()


def emcy_short(scene: SdoRequestContext) -> list[SendFrame]:
    return [scene.frame(EMCY, b"\x10\x81\x11"), *scene.honest()]


def emcy_burst(scene: SdoRequestContext) -> list[SendFrame]:
    return [*(scene.frame(EMCY, bytes((i, 0x10, 0x01, 0, 0, 0, 0, 0))) for i in range(20)), *scene.honest()]


def boot_storm(scene: SdoRequestContext) -> list[SendFrame]:
    return [*(SendFrame(CanFrame(HEARTBEAT + n, b"\0")) for n in STORM), *scene.honest()]


def extended(scene: SdoRequestContext) -> list[SendFrame]:
    return [SendFrame(CanFrame(0x580 + scene.node, scene.false, extended=True))]


def honest(scene: SdoRequestContext) -> list[SendFrame]:
    """Reply correctly. The fault of the test case consists of frames that the node ignores or does not send."""
    return [scene.reply(data) for data in scene.true]


def block_size(size: int) -> SdoReplyFunction:
    """Block download: announce `size` segments per sub-block; 1 to 127 are allowed."""

    def play(scene: SdoRequestContext) -> list[SendFrame]:
        if not scene.opens:
            return honest(scene)
        data = scene.true[0]
        return [scene.reply(data[:4] + bytes((size,)) + data[5:])]

    return play


def refuses_crc(scene: SdoRequestContext) -> list[SendFrame]:
    """Block download: report a wrong check sum at the end."""
    if scene.true[0][0] != 0xA1:
        return honest(scene)
    mux = scene.memory["mux"].to_bytes(3, "little")
    return [scene.reply(b"\x80" + mux + (0x05040004).to_bytes(4, "little"))]


def unanswered(scene: SdoRequestContext) -> list[SendFrame]:
    """Send no reply, as if the request or the reply had been lost on the bus."""
    return []


def aborts_amid(scene: SdoRequestContext) -> list[SendFrame]:
    """Abort a segmented upload after the first segment."""

    def segment(n: int) -> bytes:
        if n == 1:
            return b"\0" + scene.poison.ljust(7, b"\0")
        return b"\x80" + scene.memory["mux"].to_bytes(3, "little") + (0x08000022).to_bytes(4, "little")

    return _segmented(scene, segment)


def refuses_write(scene: SdoRequestContext) -> list[SendFrame]:
    """Refuse at once a download to an object that can only be read."""
    if not scene.opens:
        return honest(scene)
    return [scene.reply(b"\x80" + scene.request[1:4] + (0x06010002).to_bytes(4, "little"))]


def slow_segments(scene: SdoRequestContext) -> list[SendFrame]:
    """Send a segmented upload with one byte per segment, and delay each step."""
    word = scene.memory["word"].to_bytes(len(scene.poison), "little")
    after_s = SLOW * scene.timeout_s
    if scene.opens:
        scene.memory["segments"] = 0
        return [scene.reply(b"\x41" + scene.request[1:4] + len(word).to_bytes(4, "little"), after_s)]
    at = scene.memory["segments"]
    if at >= len(word):
        return scene.honest()
    scene.memory["segments"] += 1
    command = (at % 2) << 4 | 6 << 1 | (at == len(word) - 1)
    return [scene.reply(bytes((command, word[at])) + bytes(6), after_s)]


def unhurried(scene: SdoRequestContext) -> list[SendFrame]:
    """Delay each reply by more than half of a timeout, so that two consecutive replies take longer than one timeout."""
    return [scene.reply(data, 0.6 * scene.timeout_s) for data in scene.true]


def empty(scene: SdoRequestContext) -> list[SendFrame]:
    """Reply with an upload of zero bytes."""
    if scene.opens:
        scene.memory["segments"] = 0
        return [scene.reply(b"\x41" + scene.request[1:4] + bytes(4))]
    return [scene.reply(bytes((7 << 1 | 1,)) + bytes(7))]


def short_pdo(scene: SdoRequestContext) -> list[SendFrame]:
    return [scene.frame(TPDO1, scene.poison[:1]), *scene.honest()]


def pdo_outside(scene: SdoRequestContext) -> list[SendFrame]:
    """Report PRE-OPERATIONAL, and send process data (a PDO) nevertheless."""
    pdo = (scene.poison * 8)[:8]
    return [scene.frame(HEARTBEAT, bytes((PRE_OPERATIONAL,))), scene.frame(TPDO1, pdo), *scene.honest()]


def emcy_partly_over(scene: SdoRequestContext) -> list[SendFrame]:
    """Send two EMCY errors, and report one of them as cleared: the error register still shows an error."""
    told = (b"\x10\x81\x11", b"\x00\x50\x19", b"\x00\x00\x11")
    return [*(scene.frame(EMCY, data.ljust(8, b"\0")) for data in told), *scene.honest()]
