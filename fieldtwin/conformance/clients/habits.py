"""Checks of a client's own behaviour: its requests over the whole run against the standard."""

from __future__ import annotations

import itertools
import math

from fieldtwin.conformance.core.case import Finding, failed, inconclusive, passed, skipped
from fieldtwin.conformance.core.observation import Left, Observation, ObservedConnection, RequestSeen
from fieldtwin.gateway.core.clock import NS_PER_MS

TURNAROUND_MS = 100
"""SL 2.4.1: the turnaround delay is typically 100 to 200 ms; it has to be long enough for any unit to process the request."""
NO_DELAY_MS = 10
"""In milliseconds: a pause after a broadcast that is shorter than this is not a turnaround delay."""
MOST = {0x01: 2000, 0x02: 2000, 0x03: 125, 0x04: 125, 0x0F: 1968, 0x10: 123}
"""The largest number of bits or registers in a request of each function (AP 6)."""
MOST_CONNECTIONS = 4
"""The largest number of simultaneous connections that does not count as a leak, because old connections may need time to
close.
"""
READS = frozenset({0x01, 0x02, 0x03, 0x04, 0x07, 0x0B, 0x0C, 0x11, 0x14, 0x17, 0x18, 0x2B})


def broadcasts_wait(seen: Observation) -> Finding:
    asked = list(seen.of(RequestSeen))
    shortest_ms = math.inf
    broadcasts = [(a, b) for a, b in itertools.pairwise(asked) if a.target[0] == 0]
    if not any(a.target[0] == 0 for a in asked):
        return skipped("it never sent a broadcast")
    for one, following in broadcasts:
        pause_ms = (following.t_ns - one.t_ns) / NS_PER_MS
        if pause_ms < NO_DELAY_MS:
            return failed(f"the next request came {pause_ms:.0f} ms after a broadcast: there is no turnaround delay")
        shortest_ms = min(shortest_ms, pause_ms)
    if shortest_ms < TURNAROUND_MS:
        return inconclusive(
            f"the next request came {shortest_ms:.0f} ms after a broadcast; {TURNAROUND_MS} to 200 ms are usual: "
            "right only where each unit is ready again by then"
        )
    return passed()


def no_broadcast_reads(seen: Observation) -> Finding:
    for asked in seen.of(RequestSeen):
        if asked.target[0] == 0 and asked.target[1] in READS:
            return failed(f"sent a read as a broadcast: {asked.target.hex(' ')}")
    return passed(_of(seen))


def legal_requests(seen: Observation) -> Finding:
    for asked in seen.of(RequestSeen):
        function, count = asked.target[1], _count(asked.target)
        if function in MOST and not 1 <= count <= MOST[function]:
            return failed(f"asked for {count} with function {function:02X}h, 1 to {MOST[function]} are allowed")
    return passed(_of(seen))


def bounded_addresses(seen: Observation) -> Finding:
    for asked in seen.of(RequestSeen):
        start = int.from_bytes(asked.target[2:4], "big")
        if asked.target[1] in MOST and start + _count(asked.target) > 0x10000:
            return failed(f"asked for {_count(asked.target)} from {start} on: beyond 65535")
    return passed(_of(seen))


def few_connections(seen: Observation) -> Finding:
    """Check that a client that loses a connection also closes its end. An open end occupies one of the device's few
    connections.
    """
    count = most = 0
    for event in seen.events:
        count += isinstance(event, ObservedConnection) - isinstance(event, Left)
        most = max(most, count)
    if most > MOST_CONNECTIONS:
        return failed(f"{most} connections at once: it does not close those that it no longer uses")
    return passed(f"at most {most} at once")


def _count(target: bytes) -> int:
    return int.from_bytes(target[4:6], "big")


def _of(seen: Observation) -> str:
    return f"{sum(1 for _ in seen.of(RequestSeen))} requests"
