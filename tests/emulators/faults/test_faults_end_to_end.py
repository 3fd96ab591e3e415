"""Every fault end to end in virtual time: why the tag was not good, what the program saw, and how soon the system
recovered.

A value that the device did not hold is never published as good. A row without reasons is a fault that cannot be
noticed.
"""

from __future__ import annotations

import re
from typing import Any, NamedTuple

import pytest
from faults_rig import Seen, through

from fieldtwin.emulators.faults.registry import FAULTS
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.run.benches.virtual_bench import VirtualBench

NOBODY: frozenset[str] = frozenset()


class Row(NamedTuple):
    """`why`: the reason of the tag's quality during the fault. `well_s`: maximum time from its end to recovery."""

    wire: str
    name: str
    why: str
    well_s: float
    said: dict[str, Any] = {}  # noqa: RUF012  nobody changes it


ROWS = [
    Row("line", "drop", "timeout", 2.0),
    Row("lan", "drop", "timeout", 2.0),
    Row("line", "delay", "", 0.1),
    Row("lan", "delay", "", 0.1),
    Row("line", "jitter", "", 0.1),
    Row("lan", "jitter", "", 0.1),
    Row("line", "duplicate", "", 0.1),
    Row("lan", "duplicate", "", 0.1),
    Row("line", "reorder", "", 0.1),
    Row("lan", "reorder", "", 0.1),
    Row("line", "split", "", 0.1),
    Row("lan", "split", "", 0.1),
    Row("line", "pause", "", 0.1),
    Row("lan", "pause", "", 0.1),
    Row("line", "coalesce", "", 0.1),
    Row("lan", "coalesce", "", 0.1),
    Row("line", "corrupt-bits", "wire_error timeout", 2.0),
    Row("line", "corrupt-crc", "wire_error", 2.0),
    Row("line", "corrupt-length", "wire_error", 2.0),
    Row("lan", "corrupt-length", "timeout", 2.0),
    Row("line", "wrong-unit", "timeout", 2.0),
    Row("lan", "wrong-unit", "timeout", 2.0),
    Row("line", "wrong-function", "wire_error", 2.0, {"code": 3}),
    Row("lan", "wrong-function", "wire_error", 2.0, {"code": 3}),
    Row("lan", "wrong-transaction", "timeout", 2.0),
    Row("line", "fewer-registers", "wire_error timeout", 2.0),
    Row("lan", "fewer-registers", "wire_error", 2.0),
    Row("line", "truncate", "timeout", 2.0),
    Row("lan", "truncate", "timeout", 2.0),
    Row("line", "garbage", "", 0.1),
    Row("lan", "garbage", "", 0.1),
    Row("line", "noise", "", 0.1),
    Row("line", "echo", "wire_error", 2.0),
    Row("line", "late-reply", "timeout stale", 2.0),
    Row("lan", "late-reply", "timeout stale", 2.0),
    Row("line", "exception", "refused", 1.0),
    Row("lan", "exception", "refused", 1.0),
    Row("line", "busy", "stale", 1.5),
    Row("lan", "busy", "stale", 1.5),
    Row("line", "silence", "timeout", 2.0),
    Row("lan", "silence", "timeout", 2.0),
    Row("line", "half-open", "timeout", 2.0),
    Row("lan", "half-open", "timeout unreachable", 2.5),
    Row("line", "reset", "timeout", 2.0),
    Row("lan", "reset", "unreachable", 2.5),
    Row("line", "disconnect", "timeout", 2.0),
    Row("lan", "disconnect", "unreachable", 2.5),
    Row("line", "wrong-baud", "timeout wire_error", 2.0),
    Row("line", "wrong-parity", "timeout wire_error", 2.0),
    Row("line", "collision", "wire_error timeout", 2.0),
    Row("can", "lost-frame", "heartbeat_lost timeout stale", 1.5),
    Row("can", "error-frame", "", 0.1, {"every": 4}),
    Row("can", "bus-off", "", 0.5),
    Row("can", "duplicate-node", "not_operational", 1.5),
    Row("sdo", "sdo-abort", "refused", 1.0, {"register": "slope_lateral"}),
    Row("text", "sdo-toggle", "wire_error", 1.0),
    Row("text", "lost-segment", "timeout", 1.0),
    Row("can", "heartbeat-loss", "heartbeat_lost", 1.5),
    Row("can", "heartbeat-late", "", 0.1, {"most_ms": 250}),
    Row("can", "emcy-burst", "", 0.1),
    Row("can", "sync-jitter", "", 0.1),
    Row("can", "boot-storm", "not_operational", 1.0),
    Row("sdo", "late-frame", "timeout stale", 1.5, {"by_ms": 350.0, "cob_id": 0x585}),
    Row("can", "short-frame", "wire_error stale heartbeat_lost", 1.5),
    Row("can", "odd-heartbeat", "not_operational heartbeat_lost", 1.5),
    Row("sdo", "odd-sdo", "stale timeout", 1.5, {"command": 0xE0}),
    Row("line", "stuck", "", 0.1),
    Row("can", "stuck", "", 0.1),
    Row("line", "drift", "", 0.1, {"per_s": 1000.0}),
    Row("can", "drift", "", 0.1, {"per_s": 10.0, "register": "slope_long"}),
    Row("line", "spike", "", 0.1, {"by": 5000.0, "probability_each": 1.0, "register": "pressure"}),
    Row("can", "spike", "", 0.1, {"by": 50.0, "probability_each": 1.0, "register": "slope_long"}),
    Row("line", "nan", "not_a_number", 1.5),
    Row("can", "nan", "", 0.1),
    Row("line", "out-of-range", "", 0.1),
    Row("can", "out-of-range", "", 0.1),
    Row("line", "set", "", 0.1, {"value": 12.5, "register": "pressure"}),
    Row("can", "set", "", 0.1, {"value": -12.5, "register": "slope_long"}),
]

DRIVER_SAYS = {
    "timeout": "no reply within|does not answer|heartbeat lost",
    "wire_error": "check sum|a different request|another function|wrong size",
    "unreachable": "ended the connection|no reply within",
    "refused": "refused with exception 04h",
    "busy": "refused with exception 06h",
    "heartbeat_lost": "heartbeat lost",
    "duplicate-node": "two nodes seem to have the id",
}
"""The error in the driver's status, by the reason of the tag's quality or by the fault."""
NOT_A_DRIVERS = {"nan", "short-frame", "boot-storm"}
"""The driver itself reports no error for these: invalid values, one TPDO of a node that answers, short faults."""
BRIEF = {"boot-storm"}
"""Faults that a program does not see, because they end before the next scan."""
ASKED_FOR = {
    ("line", "set"): 12.5,
    ("can", "set"): -12.5,
    ("line", "out-of-range"): 1e9,
    ("can", "out-of-range"): 327.67,
}
SHIFTED_BY = {("line", "drift"): 100, ("can", "drift"): 5, ("line", "spike"): 4000, ("can", "spike"): 40}


def test_the_table_has_every_fault() -> None:
    assert {row.name for row in ROWS} == set(FAULTS)


@pytest.mark.long
def test_each_fault_has_its_effect_and_ends_with_its_time() -> None:
    run = through([(row.wire, row.name, row.said) for row in ROWS], _by_hand)
    assert run.errors == []
    wrong = [f"{row.wire} {row.name}: {what}" for row in ROWS for what in _wrong(row, run.seen[row.wire, row.name])]
    assert wrong == []
    told = run.checks[""].oracle.describe()
    assert told["wrong"] == 0, told
    assert told["checked"] > 3000


async def _by_hand(bench: VirtualBench) -> None:
    """A value that the user sets remains set until it is cleared; an invalid one is refused with the reason and the
    remedy."""
    began_s = bench.now_s()
    for device, tag, value in (("probe", "temperature", 21.5), ("tilt", "slope_lateral", -30.0)):
        await bench.set_value(device, tag, value)
    await bench.sleep_until_s(began_s + 1.3)
    assert [_value(bench, tag) for tag in ("probe.temperature", "tilt.slope_lateral")] == [21.5, -30.0]
    for device, tag in (("probe", "temperature"), ("tilt", "slope_lateral")):
        await bench.set_value(device, tag, None)
    for said, told in REFUSED:
        with pytest.raises(UsageError, match=told):
            await bench.inject(said)
    with pytest.raises(UsageError, match=r"no tag of probe 'temprature'.*did you mean 'temperature'"):
        await bench.set_value("probe", "temprature", 1.0)
    with pytest.raises(UsageError, match="no fault 'nobody' is active"):
        await bench.clear("nobody")
    await bench.inject({"id": "mine", "name": "silence", "device": "probe"})
    with pytest.raises(UsageError, match="the fault 'mine' is already active"):
        await bench.inject({"id": "mine", "name": "silence", "device": "probe"})
    await bench.clear("mine")
    await bench.sleep_until_s(began_s + 2.6)
    assert _value(bench, "probe.temperature") != 21.5
    assert _value(bench, "tilt.slope_lateral") != -30.0


REFUSED: list[tuple[dict[str, Any], str]] = [
    ({"name": "drop"}, "fault drop has no target; expected device: NAME, or bus: NAME"),
    ({"name": "drop", "device": "prob"}, "no device 'prob'.*did you mean 'probe'"),
    ({"name": "drop", "bus": "lam"}, "no bus 'lam'.*did you mean 'lan'"),
    ({"name": "drop", "device": "tilt"}, "fault drop is for serial lines and sockets"),
    ({"name": "bus-off", "bus": "lan"}, "fault bus-off is for CAN buses"),
    ({"name": "stuck"}, "fault stuck has no target"),
    ({"name": "stuck", "device": "tilt", "nth": 3}, "unknown key 'nth' in fault stuck"),
    ({"name": "bus-off", "device": "tilt", "function": 3}, "unknown key 'function' in fault bus-off"),
    ({"name": "drop", "device": "probe", "cob_id": 3}, "unknown key 'cob_id' in fault drop"),
    ({"name": "lost-frame", "bus": "can0", "register": "slope_long"}, "a register needs a device"),
    ({"name": "stuck", "device": "probe", "register": "presure"}, "no tag of probe 'presure'.*did you mean 'pressure'"),
    ({"name": "drop", "bus": "lan", "register": "pressure"}, "a register needs a device"),
    ({"name": "drop", "bus": "lan", "address": "x"}, "an address; expected a number, or holding:0x10"),
    ({"name": "drop", "bus": "lan", "by": 1}, "unknown key 'by' in fault drop"),
]


def _value(bench: VirtualBench, tag: str) -> Any:
    reading = bench.reading(tag)
    assert reading is not None
    return reading.value


def _wrong_with_driver(row: Row, seen: Seen) -> list[str]:
    """One unreadable object leaves a node online and its driver without an error."""
    told = [text for text in seen.driver_says if "two nodes" not in text or row.name == "duplicate-node"]
    if row.wire in ("sdo", "text") or row.name in NOT_A_DRIVERS:
        return []
    if not row.why:
        return [f"the driver says {told}"] if told else []
    expected = DRIVER_SAYS.get(row.name) or "|".join(DRIVER_SAYS[why] for why in row.why.split() if why in DRIVER_SAYS)
    if not any(re.search(expected, text) for text in told):
        return [f"the driver says {told}, and nothing of {expected}"]
    return []


def _wrong(row: Row, seen: Seen) -> list[str]:
    found = []
    if not seen.struck:
        found.append("it never struck")
    expected = set(row.why.split())
    if not seen.reasons <= expected or (expected and not seen.reasons):
        found.append(f"not good because {sorted(seen.reasons)} instead of {row.why or 'never'}")
    if not expected and seen.program_saw:
        found.append("the program saw it")
    if expected and seen.reasons and not seen.program_saw and row.wire != "text" and row.name not in BRIEF:
        found.append("the program did not see it")
    found += _wrong_with_driver(row, seen)
    if seen.well_s is None or seen.well_s > row.well_s + 0.05:
        found.append(f"well after {seen.well_s} s instead of {row.well_s}")
    key = (row.wire, row.name)
    late = seen.values[len(seen.values) * 3 // 4 :]
    if key in ASKED_FOR and late != [pytest.approx(ASKED_FOR[key])] * len(late):
        found.append(f"the values were {late}")
    if key in SHIFTED_BY and not late[-1] > SHIFTED_BY[key]:
        found.append(f"the values were {late}")
    if row.name == "stuck" and len(set(late)) != 1:
        found.append(f"the values were {late}")
    return found
