"""Faults of a prototype: list kinds with their parameters and active faults with their counts, inject and clear faults."""

from __future__ import annotations

from typing import Any

import msgspec
from starlette.requests import Request

from fieldtwin.studio.api.common import INSTANCE, prototype, recordings_of
from fieldtwin.studio.api.operation import Operation, body_of


class InjectFault(msgspec.Struct, forbid_unknown_fields=True):
    """A fault as in a fault file: ``{"name": "silence", "device": "ctd"}``. Its times count from the request."""

    fault: dict[str, Any]


async def list_fault_kinds(request: Request) -> list[dict[str, Any]]:
    """Return every kind of fault with its parameters as JSON schema, and the targets at which it can be aimed."""
    from fieldtwin.emulators.faults.description import describe_fault  # here: a plant has no emulators installed
    from fieldtwin.emulators.faults.registry import FAULTS

    return [describe_fault(kind) for kind in FAULTS.values()]


async def list_faults(request: Request) -> dict[str, Any]:
    """Return the active faults, every fault so far with the number of times it took effect, and the values that are set."""
    attachment = await prototype(request)
    field = msgspec.to_builtins(attachment.field) if attachment.field is not None else {}
    return {"active": field.get("faults", []), "history": field.get("struck", []), "set": field.get("set", {})}


async def inject_fault(request: Request) -> dict[str, Any]:
    """Inject a fault and return its id."""
    attachment = await prototype(request)
    form = await body_of(request, InjectFault)
    now_ns = attachment.now_ns()
    found = await attachment.field_channel.call("fault", fault=form.fault, start_ns=now_ns)
    await attachment.look_at_field()
    recordings_of(request).note(attachment, now_ns, {"fault": {"id": found["id"], **form.fault}})
    return {"id": found["id"], "active": found["faults"]}


async def clear_fault(request: Request) -> dict[str, Any]:
    """Clear one fault."""
    attachment = await prototype(request)
    now_ns = attachment.now_ns()
    found = await attachment.field_channel.call("clear", id=request.path_params["fault"])
    await attachment.look_at_field()
    recordings_of(request).note(attachment, now_ns, {"clear": request.path_params["fault"]})
    return {"active": found["faults"]}


async def clear_faults(request: Request) -> dict[str, Any]:
    """Clear all faults."""
    attachment = await prototype(request)
    for fault in list(attachment.field.faults if attachment.field is not None else []):
        now_ns = attachment.now_ns()
        await attachment.field_channel.call("clear", id=fault.id)
        recordings_of(request).note(attachment, now_ns, {"clear": fault.id})
    await attachment.look_at_field()
    return {"active": []}


OPERATIONS = (
    Operation("GET", "/faults", list_fault_kinds, "List all kinds of faults with their parameters"),
    Operation("GET", f"{INSTANCE}/faults", list_faults, "List the faults of an instance"),
    Operation("POST", f"{INSTANCE}/faults", inject_fault, "Inject a fault", body=InjectFault, changes=True),
    Operation("DELETE", f"{INSTANCE}/faults", clear_faults, "Clear all faults", changes=True),
    Operation("DELETE", INSTANCE + "/faults/{fault:path}", clear_fault, "Clear one fault", changes=True),
)
