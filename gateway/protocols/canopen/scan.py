"""Who is on this bus: first listening for heartbeats, then asking every node id for its device type. Reads only.

Paced, so that a plant that runs does not feel it: one request at a time, a pause between two.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

from fieldtwin.gateway.core.clock import NS_PER_S, Clock
from fieldtwin.gateway.core.errors import Desync, ReplyTimeout, SdoAborted
from fieldtwin.gateway.protocols.canopen.cob_id import NODE_MAX
from fieldtwin.gateway.protocols.canopen.configure import DEVICE_TYPE, Identity, read_identity
from fieldtwin.gateway.protocols.canopen.datatypes import LengthMismatch
from fieldtwin.gateway.protocols.canopen.master import CanopenMaster
from fieldtwin.gateway.protocols.canopen.nmt import NmtState


@dataclass(frozen=True, slots=True)
class FoundNode:
    """A node that is there.

    `state` is from its heartbeat or boot-up, None where it sent none. `identity` is None where it gave none; `answers`
    says whether it answers SDOs at all (a stopped node does not: CO-028).
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
    """The nodes of the bus, by node id. `on_progress` is told each node id before it is asked.

    Takes `listen_s` and, of each node id that is not there, `timeout_s` and `pause_s`: 17 s for all with these defaults.
    Raises `ConnectionLost`.
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
    """Whether the node answers, and its identity."""
    try:
        await master.sdo_upload(node, DEVICE_TYPE, 0, timeout_s, retries=0)
    except ReplyTimeout:
        return False, None
    except SdoAborted:
        return True, None
    except Desync:
        return True, None  # it answers, and nonsense
    try:
        return True, await read_identity(master, node)
    except (SdoAborted, ReplyTimeout, Desync, LengthMismatch):
        return True, None


async def _pause(clock: Clock, seconds: float) -> None:
    await clock.sleep_until_ns(clock.monotonic_ns() + int(seconds * NS_PER_S))
