"""Cases of NMT, error control and LSS: they stop the node, restart it, or send to other nodes on the bus as well.

The user who runs them has stopped the plant. After each case a node that was OPERATIONAL is started again. Clauses are CiA
301's.
"""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from fieldtwin.conformance.core.case import Finding, passed
from fieldtwin.conformance.devices.canopen.checks import begin_upload, long_object, verdict
from fieldtwin.conformance.devices.canopen.connection import (
    ERROR_CONTROL,
    LSS_REPLY,
    LSS_REQUEST,
    NMT,
    OPERATIONAL,
    PRE_OPERATIONAL,
    SDO_REPLY,
    STOPPED,
    NodeConnection,
    mux,
)
from fieldtwin.conformance.devices.device_case import NotHere, Unsaid
from fieldtwin.gateway.core.canframe import CanFrame

START, STOP, ENTER_PRE_OPERATIONAL, RESET_NODE, RESET_COMMUNICATION = 0x01, 0x02, 0x80, 0x81, 0x82
NAMES = {OPERATIONAL: "OPERATIONAL", STOPPED: "STOPPED", PRE_OPERATIONAL: "PRE-OPERATIONAL", 0: "boot-up"}


@asynccontextmanager
async def _restored(wire: NodeConnection) -> AsyncIterator[None]:
    """Restore the node's present NMT state at the end; PRE-OPERATIONAL if the node never reported its state."""
    before = wire.state
    try:
        yield
    finally:
        await wire.command(START if before == OPERATIONAL else STOP if before == STOPPED else ENTER_PRE_OPERATIONAL)
        await wire.pause()


async def _reset(wire: NodeConnection, command: int) -> Finding:
    async with _restored(wire):
        wire.forget()
        await wire.command(command)
        if not await wire.boots():
            return await verdict(wire, f"no boot-up within {wire.boot_s:g} s")
        beat = await wire.hear(ERROR_CONTROL + wire.node, min(2.0, wire.boot_s))
        if beat is not None and beat.data not in (b"\x7f", b"\x00"):
            told = NAMES.get(beat.data[0] & 0x7F, beat.data.hex()) if beat.data else "nothing"
            return await verdict(wire, f"boots, then reports {told} instead of PRE-OPERATIONAL")
        return await verdict(wire, "")


async def reset_node(wire: NodeConnection) -> Finding:
    """CO-032: send "reset node". The node must send its boot-up message and enter PRE-OPERATIONAL."""
    return await _reset(wire, RESET_NODE)


async def reset_communication(wire: NodeConnection) -> Finding:
    """CO-032: send "reset communication". The node must send its boot-up message and enter PRE-OPERATIONAL."""
    return await _reset(wire, RESET_COMMUNICATION)


async def reset_in_a_transfer(wire: NodeConnection) -> Finding:
    """CO-027: reset the node in the middle of an upload. It must send its boot-up message and forget the transfer."""
    async with _restored(wire):
        await begin_upload(wire, await long_object(wire))
        wire.forget()
        await wire.command(RESET_COMMUNICATION)
        if not await wire.boots():
            return await verdict(wire, f"no boot-up within {wire.boot_s:g} s")
        reply = await wire.ask(b"\x60")
        if reply.data and not reply.abort:
            return await verdict(wire, f"continues the earlier transfer: {reply}")
        return await verdict(wire, "")


async def stopped(wire: NodeConnection) -> Finding:
    """CO-028: send an SDO request in STOPPED. The node must not answer."""
    async with _restored(wire):
        await wire.command(STOP)
        await wire.pause()
        reply = await wire.ask(b"\x40" + mux(0x1000))
        await wire.command(ENTER_PRE_OPERATIONAL)
        await wire.pause()
        return await verdict(wire, f"{reply} in STOPPED" if reply.data else "")


async def odd_commands(wire: NodeConnection) -> Finding:
    """CO-033: send resets of one and of three bytes, and one to a node ID that does not exist."""
    async with _restored(wire):
        wire.forget()
        for data in (bytes((RESET_NODE,)), bytes((RESET_NODE, wire.node, 0)), bytes((RESET_NODE, wire.node | 0x80))):
            await wire.send(CanFrame(NMT, data))
            beat = await wire.hear(ERROR_CONTROL + wire.node, max(wire.timeout_s, 0.2))
            if beat is not None and beat.data == b"\0":
                return await verdict(wire, f"resets on {data.hex(' ').upper()}")
        return await verdict(wire, "")


async def guarding(wire: NodeConnection) -> Finding:
    """CO-040: send two guard requests. The node must answer both, and alternate the toggle bit."""
    toggles = []
    for _ in range(2):
        wire.forget()
        await wire.send(CanFrame(ERROR_CONTROL + wire.node, remote=True, dlc=1))
        answer = await wire.hear(ERROR_CONTROL + wire.node)
        if answer is None or len(answer.data) != 1:
            raise NotHere("it answers no guard request")
        toggles.append(answer.data[0] >> 7)
    if toggles[0] == toggles[1]:
        raise Unsaid("the toggle bit does not change: it sends heartbeats, or its guarding is wrong")
    return passed()


async def silent_outside(wire: NodeConnection) -> Finding:
    """CO-044: observe the node outside OPERATIONAL. It must not send a PDO."""
    async with _restored(wire):
        await wire.command(ENTER_PRE_OPERATIONAL)
        await wire.pause()
        frames = await wire.listen(1.0)
        pdos = [f for f in frames if f.can_id & 0x7F == wire.node and 0x180 <= f.can_id < SDO_REPLY and f.can_id & 0x80]
        return await verdict(wire, f"sends {pdos[0]} in PRE-OPERATIONAL" if pdos else "")


async def fastscan(wire: NodeConnection) -> Finding:
    """CO-057: send a fastscan, which a node that has a node ID must not answer."""
    wire.forget()
    await wire.send(CanFrame(LSS_REQUEST, b"\x51\0\0\0\0\x80\0\0"))
    if await wire.hear(LSS_REPLY) is not None:
        raise Unsaid("a node answers: it has no node ID, or answers although it has one")
    return await verdict(wire, "")
