"""Run the cases on a device, one after the other. Before each case the device must answer normally; otherwise the case is
inconclusive.

This module does not depend on a protocol; it uses a connection through the interface `Settling`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol, TypeVar

from fieldtwin.conformance.core.case import OTHER_WIRE, CasePlan, Finding, Impact, failed, inconclusive, skipped
from fieldtwin.conformance.devices.device_case import DeviceCase, DeviceResult, NotHere, Spoken, Unsaid
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.clock import NS_PER_S, Clock
from fieldtwin.gateway.core.connection import Direction, Tap
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import Unreachable

MOST_SPOKEN = 400
"""Maximum number of chunks or frames of a case that are kept; later ones are dropped."""
MOST_BYTES = 512
"""Maximum number of bytes of one sent or received chunk that are kept."""
MOST_LOST = 3
"""Number of consecutive cases before which the device could not be recovered; the remaining cases are then inconclusive."""


class Settling(Protocol):
    """The interface of a connection that a run of cases needs: the permitted impact level, the features of the transport,
    and `settle`, which restores normal operation and returns whether that succeeded.
    """

    impact: Impact
    traits: frozenset[str]

    async def settle(self) -> bool: ...


class Transcript(Tap):
    """A record of all traffic since `begin`, with a size limit."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._began_ns = clock.monotonic_ns()
        self._spoken: list[Spoken] = []

    def begin(self) -> None:
        self._began_ns = self._clock.monotonic_ns()
        self._spoken = []

    @property
    def spoken(self) -> tuple[Spoken, ...]:
        return tuple(self._spoken)

    def on_bytes(self, endpoint: Endpoint, direction: Direction, t_ns: int, data: bytes) -> None:
        more = f" and {len(data) - MOST_BYTES} more" if len(data) > MOST_BYTES else ""
        self._add(t_ns, direction, data[:MOST_BYTES].hex(" ").upper() + more)

    def on_frame(self, endpoint: Endpoint, direction: Direction, t_ns: int, frame: CanFrame) -> None:
        self._add(t_ns, direction, str(frame))

    def _add(self, t_ns: int, direction: Direction, text: str) -> None:
        if len(self._spoken) < MOST_SPOKEN:
            self._spoken.append(Spoken(max(0, t_ns - self._began_ns), direction, text))


W = TypeVar("W", bound=Settling)


def why_not(case: DeviceCase[W], plan: CasePlan, traits: frozenset[str]) -> str:
    """Return the reason for which the case is not run with that plan on that transport; empty if it is run."""
    if case.wires and not traits & set(case.wires):
        return OTHER_WIRE
    if case.impact.rank > plan.at_most.rank:
        return f"impact {case.impact.value}: --allow {case.impact.value}"
    missing = [need for need in case.needs if need not in plan.has]
    if missing:
        return "needs " + ", ".join(HOW_TO_GIVE.get(need, need) for need in missing)
    return ""


HOW_TO_GIVE = {
    "holding": "--write holding:ADDRESS",
    "coil": "--write coil:ADDRESS",
    "object": "--write INDEX:SUB",
    "eds": "--eds FILE",
    "i-know": "--i-know",
}


async def play(
    wire: W,
    cases: Sequence[DeviceCase[W]],
    plan: CasePlan,
    transcript: Transcript,
    clock: Clock,
    on_result: Callable[[DeviceResult], None] = lambda result: None,
    go_on: Callable[[], str] = lambda: "",
) -> list[DeviceResult]:
    """Return the results of the chosen cases, in order. Before each, `go_on` returns a reason to stop, or an empty string."""
    results: list[DeviceResult] = []
    started_ns, lost = clock.monotonic_ns(), 0
    for case in (c for c in cases if c.chosen(plan.only)):
        began_ns = clock.monotonic_ns()
        transcript.begin()
        if reason := why_not(case, plan, wire.traits):
            finding = skipped(reason)
        elif plan.for_s and began_ns - started_ns > plan.for_s * NS_PER_S:
            finding = skipped("the time of --for has passed")
        elif stop := go_on():
            finding = skipped(stop)
        elif lost >= MOST_LOST:
            finding = inconclusive("it no longer answers")
        else:
            finding, well = await _case(wire, case, transcript)
            lost = 0 if well else lost + 1
        took_s = (clock.monotonic_ns() - began_ns) / NS_PER_S
        results.append(DeviceResult(case.on_wire(wire.traits), finding, took_s, spoken=transcript.spoken))
        on_result(results[-1])
    return results


async def _case(wire: W, case: DeviceCase[W], transcript: Transcript) -> tuple[Finding, bool]:
    """Return the finding of a case, and whether the device answered normally before it."""
    wire.impact = Impact.READ
    if not await wire.settle():
        return inconclusive("the state before the test case was not normal: the normal request got no answer"), False
    transcript.begin()
    wire.impact = case.impact
    try:
        return await case.play(wire), True
    except NotHere as e:
        return skipped(str(e)), True
    except Unsaid as e:
        return inconclusive(str(e)), True
    except Unreachable as e:
        return failed(f"accepts no connection any more: {e.message}"), True
    finally:
        wire.impact = Impact.READ
