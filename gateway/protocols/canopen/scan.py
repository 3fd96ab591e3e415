"""Scan the bus for nodes: first listen for heartbeats, then read the device type of every node ID. The scan writes nothing.

It sends one request at a time, with a pause in between, so that a running plant is not disturbed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

from fieldtwin.gateway.core.clock import NS_PER_S, Clock
from fieldtwin.gateway.core.errors import Desync, ReplyTimeout, SdoAborted
from fieldtwin.gateway.protocols.canopen.cob_id import NODE_MAX
from fieldtwin.gateway.protocols.canopen.configure import DEVICE_TYPE, Identity, read_identity
from fieldtwin.gateway.protocols.canopen.eds.datatypes import LengthMismatch
from fieldtwin.gateway.protocols.canopen.master import CanopenMaster
from fieldtwin.gateway.protocols.canopen.nmt.states import NmtState


@dataclass(frozen=True, slots=True)
class FoundNode:
    """A node that was found.

    `state` is the state in its heartbeat or boot-up, None if it sent neither. `identity` is None if the node did not report it.
    `answers` says whether the node answers SDOs at all (a stopped node does not: CO-028).
    """

    node: int
    state: NmtState | None
    answers: bool
    identity: Identity | None


async def scan_nodes(
    master: CanopenMaster,
    clock: Clock,
    *,
    nodes: Iterable[int] = range(1, NODE_MAX + 1),
    listen_s: float = 2.0,
    pause_s: float = 0.02,
    timeout_s: float = 0.1,
    on_progress: Callable[[int], None] | None = None,
) -> tuple[FoundNode, ...]:
    """Return the nodes of the bus, by node ID. `on_progress` is called with each node ID before the request to it.

    The scan takes `listen_s`, plus `timeout_s` and `pause_s` for each absent node ID: with the defaults, at most 17 s. Raises
    `ConnectionLost`.
    """
    await _pause(clock, listen_s)
    found = []
    for node in nodes:
        if on_progress is not None:
            on_progress(node)
        answers, identity = await _ask(master, node, timeout_s)
        state = master.node_state(node)
        if answers or state is not None:
            found.append(FoundNode(node, state, answers, identity))
        await _pause(clock, pause_s)
    return tuple(found)


async def _ask(master: CanopenMaster, node: int, timeout_s: float) -> tuple[bool, Identity | None]:
    """Return whether the node answers SDO requests, and its identity, None if the node does not report it."""
    try:
        await master.sdo_upload(node, DEVICE_TYPE, 0, timeout_s, retries=0)
    except ReplyTimeout:
        return False, None
    except SdoAborted:
        return True, None
    except Desync:
        return True, None  # it answers, but with an invalid reply
    try:
        return True, await read_identity(master, node)
    except (SdoAborted, ReplyTimeout, Desync, LengthMismatch):
        return True, None


async def _pause(clock: Clock, seconds: float) -> None:
    await clock.sleep_until_ns(clock.monotonic_ns() + int(seconds * NS_PER_S))
