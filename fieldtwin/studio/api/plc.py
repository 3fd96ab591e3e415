"""The PLC: variables and their origin, forces, pause and steps. The PLC records each intervention in its audit log."""

from __future__ import annotations

from typing import Any

import msgspec
from starlette.requests import Request

from fieldtwin.studio.api.common import INSTANCE, attached, by_client, recordings_of
from fieldtwin.studio.api.operation import Operation, body_of
from fieldtwin.studio.live.state_history import StateChange


class Force(msgspec.Struct, forbid_unknown_fields=True):
    """A tag and the value that programs and outputs see until the force is removed."""

    tag: str
    value: float | bool | int


class Steps(msgspec.Struct, forbid_unknown_fields=True):
    """The number of scans that a paused PLC executes."""

    count: int = 1


async def get_plc(request: Request) -> Any:
    """Return the status of the PLC, with all inputs, outputs and variables as the process image has them."""
    return msgspec.to_builtins(await (await attached(request)).read_plc())


async def get_programs(request: Request) -> dict[str, Any]:
    """Return for each program its variables, its states and transitions, and the text of its source."""
    return (await attached(request)).programs


async def get_transitions(request: Request) -> dict[str, list[StateChange]]:
    """Return the last transitions of each program, the oldest first."""
    return {name: list(changes) for name, changes in (await attached(request)).state_history.changes.items()}


async def get_internal_variables(request: Request) -> Any:
    """Return the variables of programs that are not tags: at most 256 of them, and the number of the others as `more`.

    The PLC answers between two scans, 64 variables at a time.
    """
    attachment = await attached(request)
    return await attachment.read_internal_variables()


async def get_drawings(request: Request) -> Any:
    """Return the charts, ladder and function block diagrams of each program as SVG text; none for a PLC of an older version."""
    attachment = await attached(request)
    return await attachment.read_drawings()


async def get_drawing(request: Request) -> Any:
    """Return the present values of a drawing: of a chart its steps, transitions and actions, of a network its nodes and wires.

    The PLC answers between two scans.
    """
    attachment = await attached(request)
    program, number = request.path_params["program"], int(request.path_params["number"])
    return await attachment.plc_channel.call("drawn", program=program, number=number)


async def get_why(request: Request) -> Any:
    """Return which program last changed a tag, when, and what it had read. `now_ns` is the time to which the ages refer."""
    attachment = await attached(request)
    answer: dict[str, Any] = await attachment.plc_channel.call("why", tag=request.path_params["tag"])
    return answer | {"now_ns": attachment.now_ns()}


async def force_tag(request: Request) -> Any:
    """Force a tag."""
    attachment = await attached(request)
    form = await body_of(request, Force)
    result = await attachment.plc_channel.call("force", tag=form.tag, value=form.value, by=by_client(request))
    recordings_of(request).note(attachment, attachment.now_ns(), None, f"force {form.tag} to {form.value}")
    return result


async def unforce_tag(request: Request) -> Any:
    """Remove the force on a tag."""
    attachment = await attached(request)
    tag = request.path_params["tag"]
    result = await attachment.plc_channel.call("unforce", tag=tag, by=by_client(request))
    recordings_of(request).note(attachment, attachment.now_ns(), None, f"remove the force on {tag}")
    return result


async def unforce_all(request: Request) -> Any:
    """Remove all forces."""
    attachment = await attached(request)
    result = await attachment.plc_channel.call("unforce", all=True, by=by_client(request))
    recordings_of(request).note(attachment, attachment.now_ns(), None, "remove all forces")
    return result


async def pause_plc(request: Request) -> Any:
    """Stop executing programs; outputs keep their values."""
    return await (await attached(request)).plc_channel.call("pause", by=by_client(request))


async def continue_plc(request: Request) -> Any:
    """Continue after a pause."""
    return await (await attached(request)).plc_channel.call("go", by=by_client(request))


async def step_plc(request: Request) -> Any:
    """Execute some scans while paused."""
    attachment = await attached(request)
    form = await body_of(request, Steps)
    return await attachment.plc_channel.call("step", count=form.count, by=by_client(request))


PLC = f"{INSTANCE}/plc"
OPERATIONS = (
    Operation("GET", PLC, get_plc, "Read the PLC's status and variables"),
    Operation("GET", f"{PLC}/programs", get_programs, "Describe the programs: variables, states, transitions, source"),
    Operation("GET", f"{PLC}/transitions", get_transitions, "Read the last transitions of the programs"),
    Operation("GET", f"{PLC}/internal", get_internal_variables, "Read the variables of programs that are not tags"),
    Operation("GET", f"{PLC}/drawings", get_drawings, "Draw the charts and networks of the programs"),
    Operation("GET", PLC + "/drawings/{program}/{number:int}", get_drawing, "Read the present values of a drawing"),
    Operation("GET", PLC + "/why/{tag}", get_why, "Explain the value of a tag"),
    Operation("POST", f"{PLC}/forces", force_tag, "Force a tag", body=Force, changes=True),
    Operation("DELETE", f"{PLC}/forces", unforce_all, "Remove all forces", changes=True),
    Operation("DELETE", PLC + "/forces/{tag}", unforce_tag, "Remove a force", changes=True),
    Operation("POST", f"{PLC}/pause", pause_plc, "Pause the PLC", changes=True),
    Operation("POST", f"{PLC}/continue", continue_plc, "Continue after a pause", changes=True),
    Operation("POST", f"{PLC}/step", step_plc, "Execute scans while paused", body=Steps, changes=True),
)
