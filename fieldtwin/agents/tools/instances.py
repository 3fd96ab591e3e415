"""Tools that read running systems: tags, their histories, reasons of values, devices and buses. They change nothing."""

from __future__ import annotations

import asyncio
from typing import Any

import msgspec

from fieldtwin.agents.tool import Tool
from fieldtwin.agents.workplace import Workplace
from fieldtwin.explain.lookup import explain
from fieldtwin.gateway.core.errors import FieldtwinError, Unreachable, UsageError
from fieldtwin.gateway.core.files.nearest import did_you_mean
from fieldtwin.gateway.core.values import Quality, Reason
from fieldtwin.gateway.runtime.gateway_status import GatewayStatus, TagStatus
from fieldtwin.studio.live.attachment import Attachment
from fieldtwin.studio.live.tag_history import MOST_POINTS

ANSWERS_WITHIN_S = 10.0
"""Time in seconds in which a running gateway must have answered once."""
LOOK_EVERY_S = 0.1
LONGEST_WAIT_S = 30.0


def check_wait(seconds: float) -> None:
    """Raise `UsageError` if a call may not wait for so long."""
    if not 0 <= seconds <= LONGEST_WAIT_S:
        raise UsageError("seconds", expected=f"0 to {LONGEST_WAIT_S:g}", got=f"{seconds:g}")


class OfInstance(msgspec.Struct, forbid_unknown_fields=True):
    """A running system, as list_instances names it."""

    instance: str


class OfTags(msgspec.Struct, forbid_unknown_fields=True):
    """Tags of a running system as DEVICE.TAG; without `tags` all of them."""

    instance: str
    tags: list[str] = []


class OfTag(msgspec.Struct, forbid_unknown_fields=True):
    """A tag of a running system as DEVICE.TAG."""

    instance: str
    tag: str


class OfHistory(msgspec.Struct, forbid_unknown_fields=True):
    """The changes of a tag in the last `seconds`, thinned out to at most `points`."""

    instance: str
    tag: str
    seconds: float = 600.0
    points: int = 200


class OfWait(msgspec.Struct, forbid_unknown_fields=True):
    """A quality (good, bad, ...) for which to wait, or "" to wait for the whole time."""

    instance: str
    tag: str
    quality: str = ""
    seconds: float = 5.0


async def list_instances(work: Workplace, _: Any) -> list[dict[str, Any]]:
    """Return the running systems that the agent may read, and whether it may operate them."""
    return [
        {
            "instance": found.name,
            "running": found.running,
            "system": found.record.system if found.record else "",
            "mode": "" if found.record is None else "prototype" if found.record.prototype else "plant",
            "may_operate": work.owns(found.name),
            "trouble": found.trouble,
        }
        for found in await work.instances()
    ]


async def get_status(work: Workplace, given: OfInstance) -> dict[str, Any]:
    """Return the states of devices, buses, outputs, servers and the PLC, without the values of tags."""
    attachment = await work.read(given.instance)
    gateway = await _gateway(attachment)
    plc = attachment.plc
    return {
        "devices": gateway.devices,
        "buses": gateway.buses,
        "outputs": gateway.outputs,
        "refused_writes": gateway.refusals.counts,
        "serve": gateway.serve,
        "plc": None if plc is None else {"state": plc.state, "error": plc.error, "forces": plc.forces},
        "troubles": attachment.troubles,
    }


async def read_tags(work: Workplace, given: OfTags) -> dict[str, TagStatus]:
    """Return value, quality, reason and age of tags."""
    attachment = await work.read(given.instance)
    await _gateway(attachment)
    present = attachment.present_tags()
    return {name: present[_known(name, present)] for name in given.tags} if given.tags else present


async def get_history(work: Workplace, given: OfHistory) -> dict[str, Any]:
    """Return the changes of a tag, with the time in seconds before now."""
    attachment = await work.read(given.instance)
    if not 4 <= given.points <= MOST_POINTS or not 0 < given.seconds < 1e9:
        raise UsageError("seconds or points", expected=f"more than 0 s, and 4 to {MOST_POINTS} points")
    now_ns, name = attachment.now_ns(), _known(given.tag, attachment.history.names())
    from_ns = max(0, now_ns - int(given.seconds * 1e9))
    found, thinned = attachment.history.between(name, from_ns, now_ns, given.points)
    changes = [[round((now_ns - p.t_ns) / 1e9, 3), p.value, p.quality, p.reason] for p in found]
    return {"columns": ["seconds ago", "value", "quality", "reason"], "changes": changes, "thinned": thinned}


async def why(work: Workplace, given: OfTag) -> dict[str, Any]:
    """Return what determines a tag's present value: its quality with an explanation, its device and bus, active faults, and
    the program that wrote it.
    """
    attachment = await work.read(given.instance)
    gateway = await _gateway(attachment)
    name = _known(given.tag, (tags := attachment.present_tags()))
    tag, device = tags[name], attachment.system.devices[name.rpartition(".")[0]]
    field = attachment.field
    return {
        "tag": {name: tag},
        "explanation": explanation(tag.quality, tag.reason),
        "device": {device.name: gateway.devices[device.name]},
        "bus": {device.bus: gateway.buses[device.bus]},
        "active_faults": field.faults if field is not None else [],
        "outputs": [output for output in gateway.outputs if output.tag == name],
        "program": await _reasons(attachment, name),
    }


def explanation(quality: str, reason: str) -> list[dict[str, str]]:
    """Return the meaning of a quality other than good and of its reason, and the remedy."""
    words = [] if quality == str(Quality.GOOD) else [quality, *([reason] if reason != str(Reason.NONE) else [])]
    return [{"word": e.id, "meaning": e.meaning, "what_to_do": e.todo} for word in words for e in explain(word)]


async def wait_for_tag(work: Workplace, given: OfWait) -> dict[str, Any]:
    """Wait until a tag has a quality, or for a time, and return the tag. `reached` says whether it has that quality."""
    attachment = await work.read(given.instance)
    await _gateway(attachment)
    _known(given.tag, attachment.present_tags())
    check_wait(given.seconds)
    end_ns = attachment.now_ns() + int(given.seconds * 1e9)
    while True:
        tag = attachment.present_tags()[given.tag]
        reached = tag.quality == given.quality
        if reached or attachment.now_ns() >= end_ns:
            return {"reached": reached, given.tag: tag}
        await asyncio.sleep(LOOK_EVERY_S)


async def _gateway(attachment: Attachment) -> GatewayStatus:
    """Return the latest status of the gateway. A gateway that was just attached has a few seconds to answer."""
    end_ns = attachment.now_ns() + int(ANSWERS_WITHIN_S * 1e9)
    while attachment.gateway is None:
        if "gateway" in attachment.troubles or attachment.now_ns() > end_ns:
            raise Unreachable(attachment.troubles.get("gateway", "the gateway does not answer"), where=attachment.name)
        await asyncio.sleep(LOOK_EVERY_S)
    return attachment.gateway


async def _reasons(attachment: Attachment, tag: str) -> Any:
    try:
        return await attachment.plc_channel.call("why", tag=tag)
    except FieldtwinError as e:  # the PLC neither reads nor writes the tag, or it has ended
        return {"none": str(e)}


def _known(name: str, names: Any) -> str:
    if name not in names:
        raise UsageError(f"no tag {name[:80]!r}", expected="DEVICE.TAG", hint=did_you_mean(name, list(names)))
    return name


TOOLS = (
    Tool("list_instances", "List the running systems that you may read.", list_instances),
    Tool(
        "get_status",
        "Read the states of the devices, buses, outputs and PLC of a running system.",
        get_status,
        OfInstance,
    ),
    Tool("read_tags", "Read value, quality, reason and age of tags of a running system.", read_tags, OfTags),
    Tool("get_history", "Read the changes of a tag of a running system.", get_history, OfHistory),
    Tool(
        "why",
        "Explain the present value of a tag: quality, reason, device, bus, faults, and the program that wrote it.",
        why,
        OfTag,
    ),
    Tool("wait_for_tag", "Wait until a tag has a quality, at most 30 s, and read it.", wait_for_tag, OfWait),
)
