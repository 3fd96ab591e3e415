"""Connect to the PLC of a running instance, and find programs of a system and their proofs. This module prints nothing."""

from __future__ import annotations

import asyncio
import importlib
import socket
import sys
from collections.abc import Awaitable, Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

from fieldtwin.gateway.core.control import ControlClient
from fieldtwin.gateway.core.errors import Unreachable, UsageError
from fieldtwin.plc.program import Program
from fieldtwin.plc.prove import Proof
from fieldtwin.plc.states import StateTable
from fieldtwin.twin.plant.instance import runtime_root
from fieldtwin.twin.site.system import System

T = TypeVar("T")
ACCEPTS_WITHIN_S = 1.0
"""Time in seconds in which a process has to accept a connection before it counts as gone."""
LOOK_S = 0.02
"""Interval in seconds at which `step_and_wait` queries whether all steps are done."""


def running_instances() -> list[str]:
    """Return the names of the instances on this host whose PLC accepts connections. A killed PLC leaves its socket."""
    return sorted(p.parent.name for p in runtime_root().glob("*/plc.sock") if _accepts(p))


def _accepts(path: Path) -> bool:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.settimeout(ACCEPTS_WITHIN_S)
        try:
            probe.connect(str(path))
        except OSError:
            return False
    return True


def choose(instance: str) -> Path:
    """Return the PLC socket of an instance by name, or that of the only running instance if the name is empty. Raises
    `UsageError`, `Unreachable`.
    """
    if not instance:
        found = running_instances()
        if len(found) > 1:
            raise UsageError("several instances are running", expected="--instance NAME", got=", ".join(found))
        if not found:
            raise Unreachable("no PLC is running on this host", hint="fieldtwin run SYSTEM --prototype")
        instance = found[0]
    path = runtime_root() / instance / "plc.sock"
    if not path.exists():
        found = running_instances()
        running = f"one of {', '.join(found)}" if found else "the name of a running instance"
        raise Unreachable(f"no instance {instance!r} is running here", expected=running)
    return path


def talk_to(instance: str, ask: Callable[[ControlClient], Awaitable[T]]) -> T:
    """Connect to the PLC of an instance, run `ask` with the connection, close it, and return the answer."""

    async def main() -> T:
        client = await ControlClient.connect_unix(choose(instance))
        try:
            return await ask(client)
        finally:
            await client.aclose()

    return asyncio.run(main())


async def step_and_wait(call: Callable[..., Awaitable[Any]], count: int, by: str) -> dict[str, int]:
    """Let a paused PLC execute `count` steps; return the scans of each task when all steps are done or it runs again."""
    scans: dict[str, int] = (await call("step", count=count, by=by))["scans"]
    while True:
        now = await call("get", brief=True)
        if not now["stepping"] or now["state"] != "paused":
            return scans
        await asyncio.sleep(LOOK_S)


def parse_value(text: str, words: Sequence[str] = ()) -> bool | int | float:
    """Parse ``true``, ``false``, or a number in decimal or 0x.

    Raises `UsageError`; `words` are the values that its message lists as expected.
    """
    if text.lower() in ("true", "false"):
        return text.lower() == "true"
    try:
        return int(text, 0)
    except ValueError:
        pass
    try:
        return float(text)
    except ValueError as e:
        raise UsageError("not a value", expected=", ".join(words) or "true, false or a number", got=text) from e


# -- programs of a system ---------------------------------------------------------------------------------------------


def programs(system: System) -> dict[str, Program]:
    """Load each program of a system by name, without running it. Raises `FileInvalid`."""
    from fieldtwin.twin.plant.physical import programs_of

    folder = str(system.path.parent)
    return {config.name: config.bind((folder,)).program for config in programs_of(system)}


def chosen(system: System, name: str, has: Callable[[Program], Any], what: str) -> tuple[str, Any]:
    """Return the name of the chosen program, and what `has` finds in it. Without a `name`, the only program in which `has`
    finds something is chosen. Raises `UsageError` unless exactly one program qualifies.
    """
    found = {n: thing for n, p in programs(system).items() if (thing := has(p)) is not None}
    if name and name not in system.plc.programs:
        raise UsageError(f"no program {name!r}", expected=", ".join(system.plc.programs))
    if name:
        found = {n: thing for n, thing in found.items() if n == name}
    if not system.plc.programs:
        raise UsageError(f"{system.name} has no program", where=str(system.path), expected=f"a program with {what}")
    if not found:
        where = ", ".join([name] if name else system.plc.programs)
        raise UsageError(f"no program has {what}", got=where, hint="see docs/how-to/state-machines.md")
    if len(found) > 1:
        raise UsageError(f"several programs have {what}", expected="--program NAME", got=", ".join(found))
    return next(iter(found.items()))


def table_of(program: Program) -> StateTable | None:
    table = getattr(type(program), "table", None)
    return table if isinstance(table, StateTable) else None


def proof_of(program: Program) -> Proof | None:
    """Return the `PROOF` of the module next to the program's: that of ``mysite.pump`` is in ``mysite.pump_proof``."""
    module = type(program).__module__
    name = f"{module}_proof"
    try:
        found = getattr(importlib.import_module(name), "PROOF", None)
    except ModuleNotFoundError as e:
        if e.name != name and e.name is not None and not name.startswith(e.name):
            raise UsageError(f"{name} cannot be imported: {e}") from e
        found = getattr(sys.modules.get(module), "PROOF", None)
    return found if isinstance(found, Proof) else None
