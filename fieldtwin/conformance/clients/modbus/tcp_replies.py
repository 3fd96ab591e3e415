"""The replies of the hostile device that are possible on TCP only.

Each function takes a request (`RequestContext`) and returns the steps of the device. It does no I/O.
"""

from __future__ import annotations

from fieldtwin.conformance.clients.modbus.device import mbap
from fieldtwin.conformance.clients.modbus.setup import (
    GoSilent,
    HangUp,
    ReplyFunction,
    RequestContext,
    SendBytes,
    ServerStep,
)

BYTE_S = 0.002


def bytewise(scene: RequestContext) -> list[ServerStep]:
    frame = scene.frame(scene.true)
    return [SendBytes(frame[i : i + 1], i * BYTE_S) for i in range(len(frame))]


def with_stranger(scene: RequestContext) -> list[ServerStep]:
    return [SendBytes(mbap(scene.tag ^ 0x4000, scene.unit, scene.false) + scene.frame(scene.true))]


def other_protocol(scene: RequestContext) -> list[ServerStep]:
    return [SendBytes(mbap(scene.tag, scene.unit, scene.false, protocol=1))]


def other_protocol_first(scene: RequestContext) -> list[ServerStep]:
    return [SendBytes(mbap(scene.tag, scene.unit, scene.false, protocol=1)), SendBytes(scene.frame(scene.true), 0.020)]


def length(counted: int) -> ReplyFunction:
    return lambda scene: [SendBytes(mbap(scene.tag, scene.unit, scene.false, length=counted))]


def other_tag(change: int) -> ReplyFunction:
    return lambda scene: [SendBytes(mbap(scene.tag ^ change, scene.unit, scene.false))]


def zero_tag(scene: RequestContext) -> list[ServerStep]:
    return [SendBytes(mbap(0, scene.unit, scene.false))]


def other_tag_first(scene: RequestContext) -> list[ServerStep]:
    return [SendBytes(mbap(scene.tag ^ 0x4000, scene.unit, scene.false)), SendBytes(scene.frame(scene.true), 0.020)]


def reset(scene: RequestContext) -> list[ServerStep]:
    frame = scene.frame(scene.false)
    return [SendBytes(frame[: len(frame) // 2]), HangUp(0.005, reset=True)]


def hang_up(scene: RequestContext) -> list[ServerStep]:
    return [HangUp()]


def half_open(scene: RequestContext) -> list[ServerStep]:
    return [GoSilent()]


def closed_while_unused(scene: RequestContext) -> list[ServerStep]:
    """Answer the request, and then close the connection while the client is idle."""
    return [scene.good(), HangUp(0.050)]
