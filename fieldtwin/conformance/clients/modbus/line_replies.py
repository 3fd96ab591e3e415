"""The replies of the hostile device that are possible on any framing, and those on serial lines only.

Each function takes a request (`RequestContext`) and returns the steps of the device. It does no I/O.
"""

from __future__ import annotations

import itertools

from fieldtwin.conformance.clients.modbus.setup import ReplyFunction, RequestContext, SendBytes, ServerStep, Unplug
from fieldtwin.emulators.modbus.rtu.receiver import with_crc

SPLIT_S = 0.016
"""Time in seconds between the two halves of a split frame: the latency timer of a common USB adapter."""
OURS_AFTER_S = (0.020, 0.040, 0.010, 0.030)
"""Delays in seconds between a different unit's reply and the reply of the requested unit; successive requests use them in
turn.
"""
LATER = 0.5
"""Delay of the second exception frame of MB-021 after its request, as a fraction of the client's timeout."""
LATE = 1.5
"""Delay of a late reply after its request, as a multiple of the client's timeout."""


def nothing(scene: RequestContext) -> list[ServerStep]:
    return []


def bad_crc(scene: RequestContext) -> list[ServerStep]:
    frame = scene.frame(scene.false)
    return [SendBytes(frame[:-2] + bytes(b ^ 0xFF for b in frame[-2:]))]


def truncated(scene: RequestContext) -> list[ServerStep]:
    frame = scene.frame(scene.false)
    return [SendBytes(frame[: max(len(frame) - 3, 4)])]


def paused(scene: RequestContext) -> list[ServerStep]:
    frame = scene.frame(scene.true)
    return [SendBytes(frame[:4]), SendBytes(frame[4:], 0.010)]


def split_16_ms(scene: RequestContext) -> list[ServerStep]:
    frame = scene.frame(scene.true)
    cuts = (0, 1, 3, 5, len(frame))
    return [SendBytes(frame[a:b], i * SPLIT_S) for i, (a, b) in enumerate(itertools.pairwise(cuts))]


def glued(scene: RequestContext) -> list[ServerStep]:
    return [SendBytes(scene.from_unit(scene.neighbour, scene.false) + scene.frame(scene.true))]


def leading_noise(scene: RequestContext) -> list[ServerStep]:
    return [SendBytes(b"\x00\xff\x00" + scene.frame(scene.true))]


def trailing_zeros(scene: RequestContext) -> list[ServerStep]:
    return [SendBytes(scene.frame(scene.true) + b"\0\0")]


def echo(scene: RequestContext) -> list[ServerStep]:
    return [SendBytes(with_crc(scene.request)), SendBytes(scene.frame(scene.true), 0.005)]


def corrupt_echo(scene: RequestContext) -> list[ServerStep]:
    sent = bytearray(with_crc(scene.request))
    sent[3] ^= 0x10
    return [SendBytes(bytes(sent))]


def late(scene: RequestContext) -> list[ServerStep]:
    """Answer the first request too late, with the poison value. Requests that arrive meanwhile are answered after it."""
    return [SendBytes(scene.frame(scene.false), LATE * scene.timeout_s)]


def late_other(scene: RequestContext) -> list[ServerStep]:
    """Answer the first request only after a different request has arrived, and answer the second request afterwards."""
    if scene.first is None:
        return []
    if scene.first.request == scene.request:
        return [scene.good()]
    return [SendBytes(scene.first.frame(scene.first.false)), scene.good(0.050)]


def second_reply(scene: RequestContext) -> list[ServerStep]:
    return [scene.good(), SendBytes(scene.frame(scene.false), 0.003)]


def other_unit(scene: RequestContext) -> list[ServerStep]:
    return [SendBytes(scene.from_unit(scene.neighbour, scene.false))]


def other_unit_first(scene: RequestContext) -> list[ServerStep]:
    """Send a different unit's reply, and after it the requested unit's reply. The delay between them changes with each
    request, so that a fixed pause of the client cannot hide its reaction.
    """
    after_s = OURS_AFTER_S[scene.nth % len(OURS_AFTER_S)]
    return [SendBytes(scene.from_unit(scene.neighbour, scene.false)), SendBytes(scene.frame(scene.true), after_s)]


def other_function(scene: RequestContext) -> list[ServerStep]:
    return [SendBytes(scene.frame(bytes((scene.function ^ 0x07,)) + scene.false[1:]))]  # 03 and 04 change places


def too_few(scene: RequestContext) -> list[ServerStep]:
    data = scene.false[2:-2]
    return [SendBytes(scene.frame(bytes((scene.function, len(data))) + data))]


def too_many(scene: RequestContext) -> list[ServerStep]:
    data = scene.false[2:] + scene.false[-2:]
    return [SendBytes(scene.frame(bytes((scene.function, len(data) & 0xFF)) + data))]


def count_255(scene: RequestContext) -> list[ServerStep]:
    return [SendBytes(scene.frame(scene.false[:1] + b"\xff" + scene.false[2:]))]


def odd_count(scene: RequestContext) -> list[ServerStep]:
    data = scene.false[2:] + scene.false[-1:]
    return [SendBytes(scene.frame(bytes((scene.function, len(data) & 0xFF)) + data))]


def other_echo(scene: RequestContext) -> list[ServerStep]:
    return [SendBytes(scene.frame(scene.true[:-1] + bytes((scene.true[-1] ^ 0x01,))))]


def other_exception(scene: RequestContext) -> list[ServerStep]:
    return [SendBytes(scene.refuse(2, scene.function ^ 0x07))]


def exception(code: int) -> ReplyFunction:
    return lambda scene: [SendBytes(scene.refuse(code))]


def exception_at_once_and_later(code: int) -> ReplyFunction:
    """Send the first exception frame at once, the second one half a timeout after its request."""
    return lambda scene: [SendBytes(scene.refuse(code), LATER * scene.timeout_s if scene.nth else 0.0)]


def hole(scene: RequestContext) -> list[ServerStep]:
    return [SendBytes(scene.refuse(2))]


def garbage(scene: RequestContext) -> list[ServerStep]:
    """Send the bytes that a receiver at twice the baud rate sees: every bit is doubled, and framing errors occur."""
    frame = scene.frame(scene.false)
    out = bytearray()
    for byte in frame:
        spread = sum(3 << 2 * bit for bit in range(8) if byte >> bit & 1)
        out += bytes((spread & 0xFF | 0x80, spread >> 8 | 0xC0))
    return [SendBytes(bytes(out))]


def collision(scene: RequestContext) -> list[ServerStep]:
    """Send the overlap of two senders: a bit is 0 where either of them sends 0."""
    ours, other = scene.frame(scene.false), scene.from_unit(scene.neighbour, scene.true[:1] + scene.true[1:])
    return [SendBytes(bytes(a & b for a, b in zip(ours, other[1:] + other[:1], strict=False)))]


def bad_lrc(scene: RequestContext) -> list[ServerStep]:
    frame = scene.frame(scene.false)
    return [SendBytes(frame[:-3] + (b"0" if frame[-3:-2] != b"0" else b"1") + frame[-2:])]


def second_colon(scene: RequestContext) -> list[ServerStep]:
    """Send the beginning of a frame, then the whole reply."""
    return [SendBytes(scene.frame(scene.false)[:7] + scene.frame(scene.true))]


def long_gap(scene: RequestContext) -> list[ServerStep]:
    """Send two halves of a frame, further apart than the second that SL 2.5.2.1 allows."""
    frame = scene.frame(scene.false)
    return [SendBytes(frame[:7]), SendBytes(frame[7:], 1.2)]


def unplugged(held_s: float = 0.0) -> ReplyFunction:
    return lambda scene: [Unplug(1.0, held_s)]
