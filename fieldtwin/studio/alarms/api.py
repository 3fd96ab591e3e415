"""The alarm list of an instance: states, acknowledgement and shelving. The gateway records each action in its audit log."""

from __future__ import annotations

from typing import Any

import msgspec
from starlette.requests import Request

from fieldtwin.gateway.core.errors import Unreachable
from fieldtwin.gateway.runtime.alarms.alarm_list import ALARM
from fieldtwin.studio.api.common import INSTANCE, attached, by_client, recordings_of
from fieldtwin.studio.api.errors import NotFound
from fieldtwin.studio.api.operation import Operation, body_of


class Shelving(msgspec.Struct, forbid_unknown_fields=True):
    """The time for which an alarm is suppressed, in seconds: more than 0, and at most 86,400."""

    for_s: float


async def list_alarms(request: Request) -> Any:
    """Return each alarm with state, quality, priority, text and condition, in the order of the system file."""
    attachment = await attached(request)
    if attachment.gateway is None:
        raise Unreachable(attachment.troubles.get("gateway", "the gateway has not answered yet"))
    return msgspec.to_builtins(attachment.gateway.alarms)


async def acknowledge(request: Request) -> Any:
    """Acknowledge an alarm, and return its new status."""
    return await _act(request, "acknowledge", {"acknowledge": f"{ALARM}.{request.path_params['alarm']}"})


async def shelve(request: Request) -> Any:
    """Suppress an alarm for a time, and return its new status."""
    form = await body_of(request, Shelving)
    return await _act(request, "shelve", None, for_s=form.for_s)


async def unshelve(request: Request) -> Any:
    """End the shelving of an alarm, and return its new status."""
    return await _act(request, "unshelve", None)


async def _act(request: Request, command: str, step: dict[str, Any] | None, **args: Any) -> Any:
    """Send a command about an alarm to the gateway; `step` is the step of a scenario that repeats it."""
    attachment, name = await attached(request), request.path_params["alarm"]
    if name not in attachment.system.alarms:
        raise NotFound(f"the system has no alarm {name!r}", expected=", ".join(attachment.system.alarms))
    now_ns = attachment.now_ns()
    status = await attachment.gateway_channel.call(command, alarm=name, by=by_client(request), **args)
    recordings_of(request).note(attachment, now_ns, step, f"{command} {ALARM}.{name}")
    return status


ALARMS = f"{INSTANCE}/alarms"
OPERATIONS = (
    Operation("GET", ALARMS, list_alarms, "Read the alarm list"),
    Operation("POST", ALARMS + "/{alarm}/acknowledge", acknowledge, "Acknowledge an alarm", changes=True),
    Operation("PUT", ALARMS + "/{alarm}/shelving", shelve, "Shelve an alarm for a time", body=Shelving, changes=True),
    Operation("DELETE", ALARMS + "/{alarm}/shelving", unshelve, "End the shelving of an alarm", changes=True),
)
