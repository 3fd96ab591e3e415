"""Find instances on this host: those that run, and finished ones whose run directory is still there."""

from __future__ import annotations

import asyncio
import contextlib
from dataclasses import dataclass
from pathlib import Path

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.run.processes.run_record import RunRecord, read_record
from fieldtwin.twin.plant.instance import runtime_root

MOST = 200
ACCEPTS_WITHIN_S = 1.0
GATEWAY_SOCKET, PLC_SOCKET, FIELD_SOCKET = "gateway.sock", "plc.sock", "field.sock"


@dataclass(frozen=True)
class FoundInstance:
    """An instance. `record` is None if the run belongs to another version; `trouble` then gives the reason."""

    name: str
    dir: Path
    running: bool
    record: RunRecord | None
    trouble: str = ""


async def find_instances() -> list[FoundInstance]:
    """Return the instances of this user on this host, at most `MOST`, running ones first."""
    root = runtime_root()
    folders = sorted(p for p in root.iterdir() if p.is_dir()) if root.is_dir() else []
    found = [instance for folder in folders[:MOST] if (instance := await _look(folder)) is not None]
    return sorted(found, key=lambda instance: (not instance.running, instance.name))


async def find_instance(name: str) -> FoundInstance | None:
    """Return the instance of this name, or None."""
    if "/" in name or name in ("", ".", ".."):
        return None
    folder = runtime_root() / name
    return await _look(folder) if folder.is_dir() else None


async def _look(folder: Path) -> FoundInstance | None:
    running = await accepts(folder / GATEWAY_SOCKET)
    try:
        record = read_record(folder)
    except FileInvalid as e:
        return FoundInstance(folder.name, folder, running, None, str(e))
    if record is None:
        return None
    return FoundInstance(folder.name, folder, running, record)


async def accepts(path: Path) -> bool:
    """Return whether a process accepts connections on a Unix socket. A process that was killed leaves its socket file."""
    try:
        async with asyncio.timeout(ACCEPTS_WITHIN_S):
            _, writer = await asyncio.open_unix_connection(str(path))
    except (OSError, TimeoutError):
        return False
    writer.close()
    with contextlib.suppress(OSError):
        await writer.wait_closed()
    return True
