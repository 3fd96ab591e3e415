"""Make a running instance read its files again: the gateway its configuration, and the PLC its programs.

Each process checks its part first, and the changes are applied only if both can apply theirs.

SIGHUP and `fieldtwin reload` both use this module. It prints nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fieldtwin.gateway.core.control import ControlClient
from fieldtwin.gateway.core.errors import CheckFailed
from fieldtwin.run.processes.plc_client import choose

PATIENCE_S = 120.0
"""Time limit in seconds. A device takes its new configuration after the next read of its group, which may be slow."""


@dataclass(frozen=True)
class Reloaded:
    """The result of a reload.

    `applied`: something changed, and all changes took effect. Otherwise none did, and `restart` names the changes that
    need a restart. `warnings` are those of the new file.

    Changes are ``{"where": "plant.yaml:12:5", "what": "devices.ctd...: 1000 -> 500", "live": true}``. Those of programs
    also have "kept" (the number of variables), "new", "removed" and "changed" (their names).
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

    Raises `RemoteError` with the line if a file is invalid, or if the running programs cannot be replaced now, and the errors of
    the connections; nothing has changed then. Raises `CheckFailed` if the programs were replaced, but the system file changed
    in the meantime.
    """
    prepared = await plc.call("prepare_change", timeout_s=PATIENCE_S) if plc is not None else {"changes": []}
    programs: list[dict[str, Any]] = prepared["changes"]
    answer = await gateway.call("reload", timeout_s=PATIENCE_S, by=by, check=check or bool(programs))
    changes = [*answer["changes"], *programs]
    if programs and not check and plc is not None and all(change["live"] for change in changes):
        # the programs first: a forced variable or an active step may still be against it
        await plc.call("apply_change", timeout_s=PATIENCE_S, number=prepared["number"], by=by)
        answer = await gateway.call("reload", timeout_s=PATIENCE_S, by=by)
        if not all(change["live"] for change in answer["changes"]):
            raise CheckFailed("the programs were replaced, but the system file changed meanwhile", hint="reload again")
        changes, answer["applied"] = [*answer["changes"], *programs], True
    if answer["applied"] and answer["limits"] and plc is not None:
        await plc.call("limits", tags=answer["limits"])
    return Reloaded(answer["applied"], changes, answer["hash"], tuple(answer.get("warnings", ())))


async def go_back(plc: ControlClient, by: str, *, check: bool = False) -> Reloaded:
    """Let the programs that the last reload replaced run again, with the values of now. With `check` nothing is applied.

    Raises `RemoteError` if no reload has replaced programs, or if the running programs cannot be replaced now.
    """
    prepared = await plc.call("prepare_change", timeout_s=PATIENCE_S, back=True)
    changes = prepared["changes"]
    apply = not check and all(change["live"] for change in changes)
    if apply:
        await plc.call("apply_change", timeout_s=PATIENCE_S, number=prepared["number"], by=by)
    return Reloaded(apply, changes, "")


async def reload_instance(instance: str, by: str, *, check: bool = False, back: bool = False) -> Reloaded:
    """Call `reload`, or `go_back` if `back`, for an instance by its name; "" is the only one that runs."""
    plc_socket: Path = choose(instance)
    gateway = await ControlClient.connect_unix(plc_socket.with_name("gateway.sock"))
    try:
        plc = await ControlClient.connect_unix(plc_socket)
        try:
            return await (go_back(plc, by, check=check) if back else reload(gateway, plc, by, check=check))
        finally:
            await plc.aclose()
    finally:
        await gateway.aclose()
