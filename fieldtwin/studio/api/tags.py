"""Tags: present values, history, and values that are set in simulated devices."""

from __future__ import annotations

from typing import Any

import msgspec
from starlette.requests import Request

from fieldtwin.gateway.core.errors import CheckFailed, Unreachable, UsageError
from fieldtwin.studio.api.common import INSTANCE, attached, by_client, prototype, recordings_of, tag_of
from fieldtwin.studio.api.operation import Operation, Parameter, body_of, whole
from fieldtwin.studio.live.marks import Mark, all_marks
from fieldtwin.studio.live.tag_history import MOST_POINTS, recent

WRITE_WITHIN_S = 8.0
"""Time limit of a write in seconds, which is longer than the gateway itself waits for the device."""


class SetValue(msgspec.Struct, forbid_unknown_fields=True):
    """The value that a simulated device shall hold, in engineering units."""

    value: float | bool


class WriteValue(msgspec.Struct, forbid_unknown_fields=True):
    """A value to write to a device, in engineering units, and the value that the page showed to the user before."""

    value: float
    old: float | bool | str | None


async def list_tags(request: Request) -> dict[str, Any]:
    """Return every tag with value, quality, reason and age in seconds."""
    attachment = await attached(request)
    if attachment.gateway is None:
        raise Unreachable(attachment.troubles.get("gateway", "the gateway has not answered yet"))
    tags: dict[str, Any] = msgspec.to_builtins(attachment.present_tags())
    return tags


async def get_history(request: Request) -> dict[str, Any]:
    """Return the changes of a tag: [time in ns, value, quality, reason]."""
    attachment = await attached(request)
    device, name = tag_of(request, attachment)
    await attachment.wait_for_history()
    now_ns = attachment.now_ns()
    from_ns, to_ns = whole(request, "from_ns", 0), whole(request, "to_ns", now_ns)
    points = whole(request, "points", MOST_POINTS, 4, MOST_POINTS)
    found, thinned = attachment.history.between(f"{device}.{name}", from_ns, to_ns, points)
    return {"points": [list(point) for point in found], "thinned": thinned, "now_ns": now_ns}


async def get_recent(request: Request) -> dict[str, Any]:
    """Return, for each tag, its numbers in the last minute: [time in ns, number, or null for a value that is not good]."""
    attachment = await attached(request)
    await attachment.wait_for_history()
    return recent(attachment.history, attachment.history.names(), attachment.now_ns())


async def list_marks(request: Request) -> list[Mark]:
    """Return the times at which faults began and ended, values were set and released, and programs changed their states."""
    attachment = await attached(request)
    return all_marks(attachment.fault_marks, attachment.state_history, attachment.programs)


async def set_value(request: Request) -> dict[str, Any]:
    """Let a simulated device hold a value until it is released. This is a fault of kind `set`."""
    attachment = await prototype(request)
    device, name = tag_of(request, attachment)
    form = await body_of(request, SetValue)
    number = float(form.value)
    if number != number or number in (float("inf"), float("-inf")):
        raise UsageError("the value", expected="a finite number")
    now_ns = attachment.now_ns()
    await attachment.field_channel.call("set", device=device, tag=name, value=number)
    await attachment.look_at_field()
    value = int(number) if number.is_integer() and not isinstance(form.value, bool) else form.value
    recordings_of(request).note(attachment, now_ns, {"set": {"tag": f"{device}.{name}", "value": value}})
    return {"tag": f"{device}.{name}", "value": number}


async def release_value(request: Request) -> dict[str, Any]:
    """Release a value that was set: the simulated device holds its own value again."""
    attachment = await prototype(request)
    device, name = tag_of(request, attachment)
    now_ns = attachment.now_ns()
    await attachment.field_channel.call("set", device=device, tag=name, value=None)
    await attachment.look_at_field()
    recordings_of(request).note(attachment, now_ns, {"set": {"tag": f"{device}.{name}", "value": None}})
    return {"tag": f"{device}.{name}", "value": None}


async def write_value(request: Request) -> Any:
    """Write a tag of a device once, through the gateway, under its rules: the run must allow writes, the tag must be writable,
    the value must be within the limits, and no program may command the tag. The audit log records the user.
    """
    attachment = await attached(request)
    device, name = tag_of(request, attachment)
    form = await body_of(request, WriteValue)
    tag = f"{device}.{name}"
    seen = attachment.present_tags()[tag].value if attachment.gateway is not None else None
    if seen != form.old:
        raise CheckFailed(
            f"{tag} has changed since it was shown", expected=repr(form.old), got=repr(seen), hint="look again"
        )
    await attachment.gateway_channel.call("write", WRITE_WITHIN_S, tag=tag, value=form.value, by=by_client(request))
    return {"tag": tag, "value": form.value}


TAG = INSTANCE + "/tags/{tag}"
HISTORY = (
    Parameter("from_ns", "integer", "begin, on the run's monotonic clock"),
    Parameter("to_ns", "integer", "end"),
    Parameter("points", "integer", "at most this many points; more are thinned out, extremes and bad values stay"),
)
"""The interval and the resolution of a history."""
OPERATIONS = (
    Operation("GET", f"{INSTANCE}/tags", list_tags, "Read all tags"),
    Operation("GET", f"{INSTANCE}/recent", get_recent, "Read the last minute of all tags"),
    Operation(
        "GET",
        f"{TAG}/history",
        get_history,
        "Read the history of a tag",
        HISTORY,
    ),
    Operation("GET", f"{INSTANCE}/marks", list_marks, "List faults and changes of states with their times"),
    Operation("POST", f"{TAG}/write", write_value, "Write a writable tag of a device", body=WriteValue, changes=True),
    Operation("PUT", f"{TAG}/set", set_value, "Set a value in a simulated device", body=SetValue, changes=True),
    Operation("DELETE", f"{TAG}/set", release_value, "Release a value that was set", changes=True),
)
