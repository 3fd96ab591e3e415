"""Run a third-party program against simulated field devices, whose endpoints are in its environment; return its exit status.

The program keeps the terminal: its output is not changed, and Ctrl-C goes to it.
"""

from __future__ import annotations

import asyncio
import os
import re
import shutil
import signal
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgspec
from msgspec import structs

from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.wallclock import WallClock
from fieldtwin.run.processes.children import Child
from fieldtwin.run.processes.field_contact import FieldContact, contact_local, reachable
from fieldtwin.twin.plant.instance import Instance
from fieldtwin.twin.plant.mapping import mapped_endpoint
from fieldtwin.twin.prototype.field_process import FieldConfig, resolve
from fieldtwin.twin.prototype.field_status import FieldStatus, StruckStatus
from fieldtwin.twin.prototype.prototype import DigitalTwinPrototype
from fieldtwin.twin.site.resolved import write_resolved
from fieldtwin.twin.site.system import System

FIELD_LINGER_S = 0.5
END_WITHIN_S = 5.0
"""Time in seconds in which the program has to end after SIGTERM to this process, before it is killed."""
OURS = ("RUN", "PROFILES", "TOKEN", "TRACEBACK", "JSON", "SYSTEM", "CONTROL", "FIELD")
"""Variables that fieldtwin already uses for a different purpose. A bus whose short variable would have one of these names gets
only the longer variables.
"""

OnStart = Callable[[dict[str, str]], None]


def environment(contact: FieldContact, system: System, control: Path) -> dict[str, str]:
    """Return the environment variables that give a program the endpoints of the simulated field devices. docs/reference/with.md
    has the table."""
    env = _of_system(system, control)
    for name, bus in system.buses.items():
        endpoint = contact.mapping.get(bus.endpoint)
        if endpoint is not None:
            env |= _of_endpoint(_word(name), endpoint)
    for device_name, endpoint in contact.far.items():
        env |= _of_endpoint(f"{_word(device_name)}_FAR", endpoint)
    return env


def environment_from(status: FieldStatus, system: System, host: str, control: Path) -> dict[str, str]:
    """Return the variables of `environment` from the answer of a field simulator on `host` to `get`. Ports that cannot be
    reached from this host are omitted.
    """
    env: dict[str, str] = {}
    for bus, url in status.listening.items():
        with suppress(UsageError):  # a virtual serial port on another host cannot be reached
            endpoint = mapped_endpoint(system.buses[bus].endpoint, reachable(Endpoint.parse(url), host))
            env |= _of_endpoint(_word(bus), endpoint)
    return env | _of_system(system, control)


def _of_system(system: System, control: Path) -> dict[str, str]:
    env = {"FIELDTWIN_SYSTEM": str(system.path.resolve()), "FIELDTWIN_CONTROL": str(control)}
    for name, device in system.devices.items():
        kind = "NODE" if system.buses[device.bus].endpoint.is_can else "UNIT"
        env[f"FIELDTWIN_{_word(name)}_{kind}"] = str(device.address)
    return env


def _word(name: str) -> str:
    return re.sub(r"[^A-Z0-9]", "_", name.upper())


def _of_endpoint(word: str, endpoint: Endpoint) -> dict[str, str]:
    """Return FIELDTWIN_`word` and related variables: the short form is a path, HOST:PORT, or a CAN channel."""
    parts = {"URL": str(endpoint)}
    if endpoint.is_serial:
        short = endpoint.path
        settings = endpoint.serial
        parts |= {"TTY": short, "BAUDRATE": str(settings.baudrate), "FRAME": settings.frame}
    elif endpoint.is_can:
        short = endpoint.path
        parts |= {"INTERFACE": endpoint.interface, "CHANNEL": short}
    else:
        host, port = endpoint.address
        short = f"{host}:{port}"
    if not endpoint.is_serial and (not endpoint.is_can or endpoint.interface == "fieldtwin"):
        host, port = endpoint.address
        parts |= {"HOST": host, "PORT": str(port)}
    env = {f"FIELDTWIN_{word}_{part}": value for part, value in parts.items()}
    return env if word in OURS else {f"FIELDTWIN_{word}": short, **env}


async def run_with(
    config: FieldConfig,
    argv: Sequence[str],
    *,
    instance: str = "",
    faults: Sequence[dict[str, Any]] = (),
    on_start: OnStart,
    on_end: Callable[[list[StruckStatus]], None] = lambda struck: None,
) -> int:
    """Start the field simulator of `config`, run `argv`, and stop both. Return the exit status of `argv`.

    The status is 128 and the signal's number if a signal ended it. The `run_dir` of `config` is chosen here. `on_start` is
    called with the environment before `argv` starts, `on_end` after its end with how often each fault took effect.

    Raises `UsageError` for a missing program, before anything starts; `ChildFailed` when the field simulator ended
    during the run and the program exited with success.
    """
    program = shutil.which(argv[0])
    if program is None:
        raise UsageError(
            f"cannot start {argv[0]!r}: no such program", hint="check that it is on the PATH and executable"
        )
    twin = resolve(config)  # errors in the files are reported before anything starts
    name = instance or f"with-{os.getpid()}"
    with Instance(name) as home:
        try:
            return await _inside(
                home,
                structs.replace(config, run_dir=str(home.dir)),
                twin,
                [program, *argv[1:]],
                faults,
                on_start,
                on_end,
            )
        finally:
            if not instance:  # the folder is removed, because no other process knows its name
                shutil.rmtree(home.dir, ignore_errors=True)


async def _inside(
    home: Instance,
    config: FieldConfig,
    twin: DigitalTwinPrototype,
    argv: list[str],
    faults: Sequence[dict[str, Any]],
    on_start: OnStart,
    on_end: Callable[[list[StruckStatus]], None],
) -> int:
    system = twin.ecs.system
    resolved = write_resolved(home.path("prototype.pickle"), system, twin.prototype)
    path = home.path("field.json")
    path.write_bytes(msgspec.json.encode(structs.replace(config, resolved=resolved)))
    path.chmod(0o600)
    child = Child("field", "fieldtwin.twin.prototype.field_process", path, home.dir, FIELD_LINGER_S)
    try:
        contact = await contact_local(await child.connect(), system, home.dir)
        try:
            env = environment(contact, system, child.socket)
            start_ns = WallClock().monotonic_ns()
            for fault in faults:
                await contact.client.call("fault", fault=fault, start_ns=start_ns)
            on_start(env)
            status = await _run_program(argv, env)
            if faults and child.failure() is None:
                on_end((await contact.client.ask("get", FieldStatus)).struck)
        finally:
            await contact.aclose()
        failed = child.failure()
        if failed is not None and status == 0:
            raise failed
        return status
    finally:
        await child.end()


async def _run_program(argv: list[str], env: Mapping[str, str]) -> int:
    loop = asyncio.get_running_loop()
    terminated = asyncio.Event()
    process: asyncio.subprocess.Process | None = None
    early: list[int] = []

    def pass_on(number: int) -> None:
        if process is None:
            early.append(number)
            return
        with suppress(ProcessLookupError):
            process.send_signal(number)

    def interrupted() -> None:
        if process is None or not _has_terminal():  # otherwise the terminal has sent the signal to the program too
            pass_on(signal.SIGINT)

    def to_end() -> None:
        pass_on(signal.SIGTERM)
        terminated.set()

    # before a program exists that could receive the signal without us
    loop.add_signal_handler(signal.SIGINT, interrupted)
    loop.add_signal_handler(signal.SIGTERM, to_end)
    try:
        try:
            process = await asyncio.create_subprocess_exec(*argv, env={**os.environ, **env})
        except OSError as e:
            raise UsageError(f"cannot start {argv[0]!r}: {e.strerror or e}") from e
        for number in early:
            pass_on(number)
        ended = asyncio.ensure_future(process.wait())
        told = asyncio.ensure_future(terminated.wait())
        try:
            await asyncio.wait([ended, told], return_when=asyncio.FIRST_COMPLETED)
            if not ended.done():
                await asyncio.wait([ended], timeout=END_WITHIN_S)
            if not ended.done():
                pass_on(signal.SIGKILL)
            code = await ended
        finally:
            told.cancel()
            await asyncio.gather(told, return_exceptions=True)
    finally:
        loop.remove_signal_handler(signal.SIGINT)
        loop.remove_signal_handler(signal.SIGTERM)
    return code if code >= 0 else 128 - code


def _has_terminal() -> bool:
    """Return whether Ctrl-C in this terminal reaches the program too: both are in its foreground process group."""
    try:
        return os.isatty(sys.stdin.fileno()) and os.tcgetpgrp(sys.stdin.fileno()) == os.getpgrp()
    except (OSError, ValueError, AttributeError):
        return False
