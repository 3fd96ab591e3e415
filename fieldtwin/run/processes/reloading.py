"""Make a running instance read its files again: the gateway checks and applies them, and sends new limits to the PLC.

SIGHUP and `fieldtwin reload` both use this module. It prints nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fieldtwin.gateway.core.control import ControlClient
from fieldtwin.run.processes.plc_client import choose

PATIENCE_S = 120.0
"""Time limit in seconds. A device takes its new configuration after the next read of its group, which may be slow."""


@dataclass(frozen=True)
class Reloaded:
    """The result of a reload.

    `applied`: something changed, and all changes took effect. Otherwise none did, and `restart` names the changes that
    need a restart. `warnings` are those of the new file.

    Changes are ``{"where": "plant.yaml:12:5", "what": "devices.ctd...: 1000 -> 500", "live": true}``.
    """

    applied: bool
    changes: list[dict[str, Any]]
    hash: str
    warnings: tuple[str, ...] = ()

    @property
    def restart(self) -> list[dict[str, Any]]:
        return [change for change in self.changes if not change["live"]]


async def reload(gateway: ControlClient, plc: ControlClient | None, by: str, *, check: bool = False) -> Reloaded:
    """Make the instance to which these two clients are connected read its files again. With `check` nothing is applied.

    Raises `RemoteError` with the line if a file is invalid, and the errors of the connections; nothing has changed
    then.
    """
    programs = (await plc.call("sources"))["changed"] if plc is not None else []
    answer = await gateway.call("reload", timeout_s=PATIENCE_S, by=by, check=check or bool(programs))
    changes = [*answer["changes"], *map(_of_program, programs)]
    if answer["applied"] and answer["limits"] and plc is not None:
        await plc.call("limits", tags=answer["limits"])
    return Reloaded(answer["applied"], changes, answer["hash"], tuple(answer.get("warnings", ())))


def _of_program(source: dict[str, str]) -> dict[str, Any]:
    """Return a changed file of a running program as a change that a reload cannot apply."""
    what = f"plc.programs.{source['program']}: its file changed since the PLC read it ({source['cure']})"
    return {"where": source["path"], "what": what, "live": False}


async def reload_instance(instance: str, by: str, *, check: bool = False) -> Reloaded:
    """Call `reload` for an instance by its name; "" is the only one that runs."""
    plc_socket: Path = choose(instance)
    gateway = await ControlClient.connect_unix(plc_socket.with_name("gateway.sock"))
    try:
        plc = await ControlClient.connect_unix(plc_socket)
        try:
            return await reload(gateway, plc, by, check=check)
        finally:
            await plc.aclose()
    finally:
        await gateway.aclose()
