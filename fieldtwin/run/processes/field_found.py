"""Find the field simulator of `--target compose` if the user named none.

In this order: FIELDTWIN_CONTROL (the scenario runs under `fieldtwin with`), the field simulator in the instance's own
run directory, the only field simulator of this system that runs on this host without a gateway (`fieldtwin with`,
`fieldtwin emulate`), and the host `field` of the compose file.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

from fieldtwin.gateway.core.control import ControlClient
from fieldtwin.gateway.core.errors import FieldtwinError, UsageError
from fieldtwin.twin.prototype.field_status import FieldStatus
from fieldtwin.twin.site.system import System

DEFAULT_HOST = "field"
MOST_LOOKED_AT = 200
"""Largest number of run directories that are examined."""


async def find_field(system: System, run_dir: Path, environ: Mapping[str, str] = os.environ) -> tuple[str, Path | None]:
    """Return the address of the field simulator: either a host and no path, or an empty host and the path of a Unix socket.

    Raises `UsageError` if there are several.
    """
    if said := environ.get("FIELDTWIN_CONTROL"):
        return "", Path(said)
    own = run_dir / "field.sock"
    if own.exists():
        return "", own
    if not (run_dir / "gateway.sock").exists():
        found = [path for path in _sockets(run_dir.parent) if await _is_of(path, system)]
        if len(found) > 1:
            raise UsageError(
                f"several field simulators of {system.name!r} run on this host",
                expected="--instance with one of " + ", ".join(path.parent.name for path in found),
            )
        if found:
            return "", found[0]
    return DEFAULT_HOST, None


def _sockets(root: Path) -> list[Path]:
    """Return the control channels of field simulators whose instance has no gateway."""
    try:
        homes = sorted(root.iterdir())[:MOST_LOOKED_AT]
    except OSError:
        return []
    return [
        home / "field.sock" for home in homes if (home / "field.sock").exists() and not (home / "gateway.sock").exists()
    ]


async def _is_of(path: Path, system: System) -> bool:
    """Return whether the field simulator that listens at the socket `path` simulates exactly this system file."""
    try:
        client = await ControlClient.connect_unix(path)
    except FieldtwinError:
        return False  # the socket was left by a process that was killed
    try:
        return (await client.ask("get", FieldStatus)).system_hash == system.hash
    except FieldtwinError:
        return False
    finally:
        await client.aclose()
