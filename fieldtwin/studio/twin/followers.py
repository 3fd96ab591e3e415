"""Find the shadows and twins of an instance on this computer, and read their statuses through their control channels.

A shadow that runs on another computer is not found: only its own run directory knows its control channel.
"""

from __future__ import annotations

import asyncio
import contextlib
import shlex
from collections.abc import AsyncIterator
from dataclasses import dataclass, replace
from pathlib import Path

from fieldtwin.gateway.core.control import ControlClient
from fieldtwin.gateway.core.errors import FieldtwinError, Unreachable
from fieldtwin.run.processes.run_record import RunRecord
from fieldtwin.run.shadow.status import TwinStatus
from fieldtwin.studio.live.attachment import Attachment
from fieldtwin.studio.live.instances import MOST, accepts
from fieldtwin.twin.plant.instance import runtime_root
from fieldtwin.twin.site.data_files import search_path
from fieldtwin.twin.thread.status import PlantThreadStatus

KINDS = ("twin", "shadow")
THREAD_SOCKET = "thread.sock"
ANSWERS_WITHIN_S = 1.0
EXAMPLE_PLACE = "tcp://127.0.0.1:7700"


@dataclass(frozen=True)
class Follower:
    """A running shadow or twin of the same system. `status` is None if it does not answer; `trouble` then gives the reason.

    `is_of_instance` is true if it receives the log of this instance, false if that of another one, and None if it is not known.
    """

    instance: str
    kind: str
    status: TwinStatus | None
    trouble: str = ""
    is_of_instance: bool | None = None


async def _plant_thread(attachment: Attachment) -> PlantThreadStatus | None:
    with contextlib.suppress(FieldtwinError):
        async with _client(attachment.dir / THREAD_SOCKET) as client:
            return await client.ask("get", PlantThreadStatus, ANSWERS_WITHIN_S)
    return None


async def look(attachment: Attachment) -> tuple[PlantThreadStatus | None, list[Follower]]:
    """Return the instance's own end of the digital thread, None if it has none or does not answer, and the shadows and twins of
    its system, those of this instance first.
    """
    root = runtime_root()
    folders = sorted(p for p in root.iterdir() if p.is_dir()) if root.is_dir() else []
    sockets = [folder / f"{kind}.sock" for folder in folders[:MOST] for kind in KINDS]
    looks = (_look(socket, attachment) for socket in sockets if socket.is_socket())
    thread, found = await asyncio.gather(_plant_thread(attachment), asyncio.gather(*looks))
    kept = [replace(f, is_of_instance=_is_of(f.status, thread)) for f in found if f is not None]
    return thread, sorted(kept, key=lambda f: (f.is_of_instance is not True, f.kind != "twin", f.instance))


async def _look(socket: Path, attachment: Attachment) -> Follower | None:
    name, kind = socket.parent.name, socket.stem
    if not await accepts(socket):
        return None  # it was killed, and left its socket
    try:
        async with _client(socket) as client:
            status = await client.ask("status", TwinStatus, ANSWERS_WITHIN_S)
    except FieldtwinError as e:
        return Follower(name, kind, None, str(e))
    if status.system != attachment.system.name:
        return None
    return Follower(name, kind, status)


def _is_of(status: TwinStatus | None, thread: PlantThreadStatus | None) -> bool | None:
    if status is None or thread is None:
        return None
    return thread.origin in status.origins if status.origins else None


@contextlib.asynccontextmanager
async def _client(socket: Path) -> AsyncIterator[ControlClient]:
    if not socket.is_socket():
        raise Unreachable("it does not run", where=str(socket))
    client = await ControlClient.connect_unix(socket)
    try:
        yield client
    finally:
        await client.aclose()


def starting_commands(attachment: Attachment, thread: PlantThreadStatus | None) -> list[dict[str, str]]:
    """Return the command lines that start a shadow or a twin of the instance, with a description of each.

    If the instance has no digital thread, the first command starts the instance again with one. A twin commands periods over
    a transmitter, so a system without one has only a shadow.
    """
    record = attachment.record
    system = shlex.quote(short_system(record))
    place = thread.place if thread is not None else EXAMPLE_PLACE
    mode = "--prototype" if record.prototype else "--plant"
    commands = [
        {"text": "Watch the plant with a shadow", "command": f"fieldtwin shadow {system} --from {shlex.quote(place)}"}
    ]
    if any(device.profile.inbox is not None for device in attachment.system.devices.values()):
        commands.append(
            {
                "text": "Command it with a twin, which starts with a period of 2 s",
                "command": f"fieldtwin twin {system} --from {shlex.quote(place)} --command 2",
            }
        )
    if thread is None:
        run = f"fieldtwin run {system} {mode} --instance {attachment.name} --studio --thread {place}"
        commands.insert(0, {"text": "Start the instance with a digital thread", "command": run})
    return commands


def short_system(record: RunRecord) -> str:
    """Return the text that names the system of a run on a command line: the name of a shipped system, or the path of its file."""
    path = Path(record.path)
    shipped = any(path.is_relative_to(place) for place in search_path())
    return path.stem if shipped else record.path
