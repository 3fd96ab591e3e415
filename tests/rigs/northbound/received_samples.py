"""The samples that an OPC UA client receives, compared with the gateway's own record."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

from asyncua import Node, ua
from procs import Asking

from fieldtwin.gateway.core.values import Quality, Reason
from fieldtwin.gateway.wallclock import WallClock
from fieldtwin.northbound.opcua.status_codes import status_code

NEAR_NS = 30_000_000
"""How far a source time may be from the gateway's own time: the server follows the host's UTC in steps of 10 ms."""
REASONS = {str(reason): reason for reason in Reason}


class Received:
    """The samples of a subscription, by tag: data value and the monotonic time of its arrival."""

    def __init__(self) -> None:
        self.samples: list[tuple[str, ua.DataValue, int]] = []

    def datachange_notification(self, node: Node, value: Any, data: Any) -> None:
        name = str(node.nodeid.Identifier)
        self.samples.append((name, data.monitored_item.Value, WallClock().monotonic_ns()))

    def latest(self, name: str) -> str:
        return next((v.StatusCode.name for n, v, _ in reversed(self.samples) if n == name), "")


def history(gateway: Asking) -> tuple[dict[str, list[tuple[Any, int]]], list[tuple[int, str, str, str]]]:
    """The gateway's own record: the good values of each tag with their times, and the changes of qualities."""
    good: dict[str, list[tuple[Any, int]]] = {}
    for _, tag, _, t_ns, value in gateway("published", since=0)["entries"]:
        good.setdefault(tag, []).append((value, t_ns))
    changes = [(t, tag, quality, reason) for _, t, tag, _, quality, reason in gateway("watch", since=0)["changes"]]
    return good, changes


def check(sample: tuple[str, ua.DataValue, int], offset_ns: int, good: Any, changes: Any) -> None:
    """Require that the gateway has recorded exactly this sample: value, status and time."""
    name, data, arrived_ns = sample
    stamp = data.SourceTimestamp
    assert stamp is not None, f"{name}: {data.StatusCode.name} without a time"
    source_ns = int((stamp.replace(tzinfo=UTC) - datetime(1970, 1, 1, tzinfo=UTC)).total_seconds() * 1e9) - offset_ns
    if data.StatusCode.is_good():
        near = [value for value, t_ns in good[name] if abs(t_ns - source_ns) < NEAR_NS]
        assert data.Value.Value in near, f"{name}: {data.Value.Value} at {source_ns}: {near}"
        return
    assert data.Value.Value is None
    known = [
        (t_ns, reason)
        for t_ns, tag, quality, reason in changes
        if tag == name and status_code(Quality[quality.upper()], REASONS[reason]).number == data.StatusCode.value
    ]
    assert any(t_ns - NEAR_NS <= source_ns <= arrived_ns + NEAR_NS for t_ns, _ in known), (
        f"{name}: {data.StatusCode.name} at {source_ns}, arrived {arrived_ns}: {known}"
    )
