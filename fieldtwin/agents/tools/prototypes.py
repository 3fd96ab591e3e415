"""Tools that operate the prototypes which the agent has started. They refuse every other running system."""

from __future__ import annotations

from typing import Any

import msgspec

from fieldtwin.agents.tool import Tool
from fieldtwin.agents.tools.instances import OfInstance
from fieldtwin.agents.workplace import Workplace
from fieldtwin.gateway.core.errors import UsageError


class StartPrototype(msgspec.Struct, forbid_unknown_fields=True):
    """A system file of the project that has a prototype file, or the name of a shipped system."""

    system: str


class InjectFault(msgspec.Struct, forbid_unknown_fields=True):
    """A fault as in a fault file, such as ``{"name": "silence", "device": "ctd"}``; its times count from now."""

    instance: str
    fault: dict[str, Any]


class ClearFaults(msgspec.Struct, forbid_unknown_fields=True):
    """The id of one fault; without it all are cleared."""

    instance: str
    id: str = ""


class SetValue(msgspec.Struct, forbid_unknown_fields=True):
    """The value that the simulated device holds, in engineering units; null releases it."""

    instance: str
    tag: str
    value: float | bool | None


async def start_prototype(work: Workplace, given: StartPrototype) -> dict[str, Any]:
    """Start the prototype of a system: emulated devices, gateway and PLC. Return the name of the instance."""
    return {"instance": await work.start_prototype(given.system)}


async def stop_prototype(work: Workplace, given: OfInstance) -> dict[str, Any]:
    """Stop a prototype."""
    await work.stop_prototype(given.instance)
    return {"stopped": given.instance}


async def list_active_faults(work: Workplace, given: OfInstance) -> dict[str, Any]:
    """Return the active faults of a prototype, how often each fault so far took effect, and the values that are set."""
    attachment = await work.operate(given.instance)
    await attachment.look_at_field()
    field = attachment.field
    return {"active": [], "history": [], "set": {}} if field is None else {
        "active": field.faults, "history": field.struck, "set": field.set,
    }  # fmt: skip


async def inject_fault(work: Workplace, given: InjectFault) -> dict[str, Any]:
    """Inject a fault and return its id and all active faults."""
    attachment = await work.operate(given.instance)
    found = await attachment.field_channel.call("fault", fault=given.fault, start_ns=attachment.now_ns())
    await attachment.look_at_field()
    return {"id": found["id"], "active": found["faults"]}


async def clear_faults(work: Workplace, given: ClearFaults) -> dict[str, Any]:
    """Clear one fault or all faults."""
    attachment = await work.operate(given.instance)
    await attachment.look_at_field()
    faults = [given.id] if given.id else [fault.id for fault in attachment.field.faults] if attachment.field else []
    for fault in faults:
        await attachment.field_channel.call("clear", id=fault)
    await attachment.look_at_field()
    return {"cleared": faults}


async def set_value(work: Workplace, given: SetValue) -> dict[str, Any]:
    """Let a simulated device hold a value, or release it."""
    attachment = await work.operate(given.instance)
    device, _, tag = given.tag.rpartition(".")
    if device not in attachment.system.devices:
        raise UsageError(f"no device {device[:80]!r}", expected=", ".join(attachment.system.devices))
    value = None if given.value is None else float(given.value)
    await attachment.field_channel.call("set", device=device, tag=tag, value=value)
    return {"tag": given.tag, "value": value}


PROTOTYPE = "prototype"
TOOLS = (
    Tool("start_prototype", "Start the prototype of a system.", start_prototype, StartPrototype, PROTOTYPE),
    Tool("stop_prototype", "Stop a prototype that you have started.", stop_prototype, OfInstance, PROTOTYPE),
    Tool("list_active_faults", "List the faults of a prototype that you have started.", list_active_faults, OfInstance),
    Tool(
        "inject_fault", "Inject a fault into a prototype that you have started.", inject_fault, InjectFault, PROTOTYPE
    ),
    Tool(
        "clear_faults", "Clear the faults of a prototype that you have started.", clear_faults, ClearFaults, PROTOTYPE
    ),
    Tool(
        "set_value",
        "Set a value in a simulated device of a prototype that you have started.",
        set_value,
        SetValue,
        PROTOTYPE,
    ),
)
