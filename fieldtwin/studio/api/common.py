"""Functions that all handlers use: they return parts of the server, and the instance or tag that a request names."""

from __future__ import annotations

from pathlib import Path
from typing import TypeVar

from starlette.requests import HTTPConnection

from fieldtwin.gateway.core.errors import NotAllowed
from fieldtwin.studio.api.errors import NotFound
from fieldtwin.studio.live.attachment import Attachment
from fieldtwin.studio.live.gallery import Gallery
from fieldtwin.studio.scenarios.recordings import Recordings

INSTANCE = "/instances/{instance}"
T = TypeVar("T")


def of_server(request: HTTPConnection, name: str, kind: type[T]) -> T:
    """Return a part of the server that `fieldtwin.studio.app` has put into the application's state."""
    part = getattr(request.app.state, name)
    assert isinstance(part, kind)
    return part


def gallery_of(request: HTTPConnection) -> Gallery:
    """Return the server's collection of observed instances (`fieldtwin.studio.live.gallery`)."""
    return of_server(request, "gallery", Gallery)


def recordings_of(request: HTTPConnection) -> Recordings:
    """Return the scenario recordings of the server, in which handlers record the actions of clients."""
    return of_server(request, "recordings", Recordings)


def folder_of(request: HTTPConnection) -> Path:
    """Return the server's working directory, which is searched for systems and scenarios."""
    return of_server(request, "folder", Path)


async def attached(request: HTTPConnection) -> Attachment:
    """Return the instance that a request names. Raises `NoInstance`, and `FileInvalid` for a run of another version."""
    return await gallery_of(request).attached(request.path_params["instance"])


async def prototype(request: HTTPConnection) -> Attachment:
    """Return the instance if its devices are simulated by this run. Raises `NotAllowed` for a plant."""
    attachment = await attached(request)
    if not attachment.record.prototype:
        raise NotAllowed("a plant has no simulated devices", expected="an instance that runs with --prototype")
    if attachment.record.field_elsewhere:
        raise NotAllowed("the simulated devices of this run are on another host", hint="operate them there")
    return attachment


def tag_of(request: HTTPConnection, attachment: Attachment) -> tuple[str, str]:
    """Return device and name of the tag that a request names. Raises `NotFound`."""
    full = request.path_params["tag"]
    device, _, name = full.rpartition(".")
    config = attachment.system.devices.get(device)
    if config is None or name not in config.profile.tags:
        raise NotFound(f"the system has no tag {full!r}", expected="DEVICE.TAG")
    return device, name


def by_client(request: HTTPConnection) -> str:
    """Return the name under which audit logs record the client of a request: that of the server, and the client's address."""
    server, client = of_server(request, "audited_as", str), request.client
    return f"{server} {client.host}" if client is not None else server
