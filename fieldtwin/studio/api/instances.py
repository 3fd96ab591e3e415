"""Instances: a list of them, the system of each, and their present statuses."""

from __future__ import annotations

from typing import Any

import msgspec
from starlette.requests import Request

from fieldtwin.studio.api.common import INSTANCE, attached, folder_of, gallery_of, of_server
from fieldtwin.studio.api.errors import NotFound
from fieldtwin.studio.api.operation import Operation, body_of
from fieldtwin.studio.live.instances import FoundInstance
from fieldtwin.studio.live.launching import Launcher, known_systems


class StartPrototype(msgspec.Struct, forbid_unknown_fields=True):
    """The system to start, as `GET /systems` lists it, and the name of the instance; by default that of the system."""

    system: str
    instance: str = ""


async def list_instances(request: Request) -> list[dict[str, Any]]:
    """Return all instances that this server shows, running ones first."""
    launcher = getattr(request.app.state, "launcher", None)  # the server of a run starts no instances
    return [
        _described(found) | {"started_here": launcher is not None and launcher.owns(found.name)}
        for found in await gallery_of(request).found()
    ]


async def list_systems(request: Request) -> list[dict[str, Any]]:
    """Return the systems that have a prototype: those of the working directory, and the shipped ones."""
    return [msgspec.to_builtins(known) for known in known_systems(folder_of(request))]


async def start_prototype(request: Request) -> dict[str, Any]:
    """Start the prototype of a known system. The request is answered when its gateway runs."""
    form = await body_of(request, StartPrototype)
    known = {system.path for system in known_systems(folder_of(request))}
    if form.system not in known:  # a page must not start arbitrary files
        raise NotFound(f"no system {form.system[:80]!r}", expected=", ".join(sorted(known)))
    instance = await _launcher(request).start(form.system, form.instance)
    await gallery_of(request).attached(instance)  # Studio keeps more changes than the gateway
    return {"instance": instance}


async def stop_instance(request: Request) -> dict[str, Any]:
    """Stop an instance that Studio has started."""
    await _launcher(request).stop(request.path_params["instance"])
    return {"stopped": request.path_params["instance"]}


def _launcher(request: Request) -> Launcher:
    return of_server(request, "launcher", Launcher)


async def get_instance(request: Request) -> dict[str, Any]:
    """Return the description of an instance: buses, devices with their tags, programs."""
    attachment = await attached(request)
    await attachment.wait_for_history()
    record = attachment.record
    return {
        "name": attachment.name,
        "mode": "prototype" if record.prototype else "plant",
        "allow_writes": record.allow_writes,
        "started_utc_ns": str(record.started_utc_ns),
        "started_ns": record.started_ns,
        "now_ns": attachment.now_ns(),
        "history_from_ns": attachment.history_from_ns,
        "frames": attachment.frames is not None,
        "role": request.scope["role"],
        "system": attachment.description,
    }


async def get_status(request: Request) -> dict[str, Any]:
    """Return the statuses of gateway, PLC and simulated devices; null for a process that does not answer."""
    return (await attached(request)).status()


def _described(found: FoundInstance) -> dict[str, Any]:
    record = found.record
    return {
        "name": found.name,
        "running": found.running,
        "trouble": found.trouble,
        "system": record.system if record else "",
        "path": record.path if record else "",
        "mode": "" if record is None else "prototype" if record.prototype else "plant",
        "allow_writes": record.allow_writes if record else False,
        "started_utc_ns": str(record.started_utc_ns) if record else "",
        "frames": bool(record and record.capture),
    }


OBSERVING = (
    Operation("GET", "/instances", list_instances, "List the instances on this computer"),
    Operation("GET", INSTANCE, get_instance, "Describe an instance"),
    Operation("GET", f"{INSTANCE}/status", get_status, "Read the statuses of an instance"),
)
LAUNCHING = (
    Operation("GET", "/systems", list_systems, "List the systems whose prototype can be started"),
    Operation("POST", "/instances", start_prototype, "Start a prototype", body=StartPrototype, changes=True),
    Operation("DELETE", INSTANCE, stop_instance, "Stop an instance that Studio has started", changes=True),
)
