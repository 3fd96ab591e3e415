"""The state of a run at an instant of its trace, in the form of the statuses of a running instance.

Scan counters and connections are missing, because a trace does not contain them. A device "answers" if one of its tags has a
value that is not bad.
"""

from __future__ import annotations

from collections import Counter
from itertools import islice
from typing import Any

from fieldtwin.gateway.core.clock import NS_PER_MS, NS_PER_S
from fieldtwin.studio.live.tag_history import BAD, Point
from fieldtwin.studio.replay.alarms import alarms_at
from fieldtwin.studio.replay.marks import faults_at, state_changes, step_at
from fieldtwin.studio.replay.replay import Replay

NEVER = Point(0, None, BAD, "never_read")
RATE_OVER_NS = 5 * NS_PER_S
LOOKS_BACK = 200
"""Number of frames of a device that are searched for a later reading of an unchanged value."""


def state_at(replay: Replay, t_ns: int) -> dict[str, Any]:
    """Return the state at an instant: every event up to and including `t_ns` has happened."""
    tags = {name: _tag(replay, name, t_ns) for name in replay.tag_names}
    changes = transitions_at(replay, t_ns)
    return {
        "now_ns": t_ns,
        "gateway": {
            "tags": tags,
            "devices": {name: _device(replay, name, tags) for name in replay.system.devices},
            "buses": {name: _bus(replay, name, t_ns) for name in replay.system.buses},
            "alarms": alarms_at(replay.log.alarms, replay.system.alarms, t_ns),
        },
        "plc": _plc(replay, t_ns, tags),
        "transitions": {name: latest[-1]["t_ns"] for name, latest in changes.items() if latest},
        "field": {"faults": faults_at(replay.log, t_ns), "set": {}, "struck": []},
        "rates": {name: _rate(replay, name, t_ns) for name in replay.system.buses},
        "step": step_at(replay.log, t_ns),
        "troubles": dict(replay.troubles),
        "frames": {
            "total": len(replay.frames),
            "before": replay.frames.position_at(t_ns + 1),
            "behind_bytes": replay.behind_bytes,
            "full": replay.frames.is_full,
        },
    }


def transitions_at(replay: Replay, t_ns: int) -> dict[str, list[dict[str, Any]]]:
    """Return the last transitions of each program before an instant, the oldest first."""
    return {
        program: [
            {"t_ns": point.t_ns, "scan": None, "before": before.value, "after": point.value, "forced": False,
             "place": "", "inputs": {}}
            for before, point in state_changes(replay.log, program, t_ns)
        ]
        for program in replay.system.plc.programs
    }  # fmt: skip


def _tag(replay: Replay, name: str, t_ns: int) -> dict[str, Any]:
    point = replay.history.at(name, t_ns)
    if point is None:
        return {"value": None, "quality": BAD, "reason": "never_read", "age_s": None}
    age_ns = t_ns - point.t_ns
    limit_ms = replay.about.stale_after_ms.get(name) if replay.about is not None else None
    if point.quality != BAD and limit_ms is not None and age_ns > limit_ms * NS_PER_MS:
        if not replay.frames.reaches(t_ns):
            point = point._replace(quality="uncertain", reason="frames_not_read_yet")
        elif not _was_read(replay, name, t_ns, t_ns - limit_ms * NS_PER_MS):
            point = point._replace(quality=BAD, reason="stale")
    return {"value": point.value, "quality": point.quality, "reason": point.reason, "age_s": age_ns / NS_PER_S}


def _was_read(replay: Replay, name: str, t_ns: int, since_ns: int) -> bool:
    """Return whether the device has sent the tag `name` between `since_ns` and `t_ns`.

    The gateway publishes only changes, so only the frames of the device show that an unchanged value was read again.
    """
    device, _, tag = name.rpartition(".")
    for row in islice(replay.frames.latest_of_device(device, t_ns + 1), LOOKS_BACK):
        if row.t_ns < since_ns:
            return False
        if tag in row.tags:
            return True
    return False


def _device(replay: Replay, name: str, tags: dict[str, dict[str, Any]]) -> dict[str, Any]:
    config = replay.system.devices[name]
    own = [seen for tag, seen in tags.items() if tag.rpartition(".")[0] == name and seen["reason"] != "never_read"]
    online = any(seen["quality"] != BAD for seen in own)
    reasons = Counter(seen["reason"] for seen in own if seen["quality"] == BAD)
    why = "" if online or not reasons else str(reasons.most_common(1)[0][0]).replace("_", " ")
    return {"bus": config.bus, "address": config.address, "online": online, "error": why}


def _bus(replay: Replay, name: str, t_ns: int) -> dict[str, Any]:
    frames = replay.frames
    counters = {"requests": frames.count_of_bus(name, t_ns + 1), "timeouts": frames.failures_of_bus(name, t_ns + 1)}
    return {"error": "", "counters": counters}


def _rate(replay: Replay, name: str, t_ns: int) -> float:
    """Return the frame rate of a bus in frames per second, averaged over the last `RATE_OVER_NS`."""
    since_ns = max(0, t_ns - RATE_OVER_NS)
    count = replay.frames.count_of_bus(name, t_ns + 1) - replay.frames.count_of_bus(name, since_ns)
    return count / max(0.1, (t_ns - since_ns) / NS_PER_S)


def _plc(replay: Replay, t_ns: int, tags: dict[str, dict[str, Any]]) -> dict[str, Any]:
    outputs = {
        name: point.value
        for name in list(replay.log.states)
        if (point := replay.history.state_at(name, t_ns)) is not None
    }
    programs = replay.about.programs if replay.about is not None else {}
    variables = {
        f"{program}.{variable}": outputs[about.tag]
        for program, description in programs.items()
        for variable, about in description.variables.items()
        if about.tag in outputs
    }
    read = {binding.tag for form in replay.system.plc.programs.values() for binding in form.inputs.values()}
    inputs = {tag: {k: tags[tag][k] for k in ("value", "quality", "reason")} for tag in sorted(read) if tag in tags}
    return {
        "state": "recorded",
        "cycle_ms": replay.system.plc.cycle_ms,
        "inputs": inputs,
        "outputs": outputs,
        "variables": variables or outputs,
        "forces": {},
        "waiting": {},
        "error": "",
    }
