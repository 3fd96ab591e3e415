"""The field simulator of a system in this process: `fieldtwin emulate SYSTEM` runs it."""

from __future__ import annotations

import shlex
from dataclasses import dataclass, field
from pathlib import Path

from fieldtwin.console import stderr
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.twin.plant.child import allow_open_files
from fieldtwin.twin.plant.instance import Instance
from fieldtwin.twin.prototype.field import FieldSimulator
from fieldtwin.twin.prototype.field_process import FieldConfig, FieldProcess, resolve
from fieldtwin.twin.site.data_files import find
from fieldtwin.twin.site.system import load_system


@dataclass(frozen=True)
class FieldOptions:
    """The options of a field simulator."""

    system: Path
    prototype_file: Path | None = None
    recordings: dict[str, str] = field(default_factory=dict)
    speed: float = 0.0
    listen: dict[str, str] = field(default_factory=dict)
    control: str = ""
    token: str = field(default="", repr=False)
    instance: str = ""
    profiles: tuple[Path, ...] = ()


async def run_field(options: FieldOptions) -> int:
    """Serve until SIGINT or SIGTERM. Prints the endpoints once they listen."""
    allow_open_files()
    system = load_system(str(options.system), options.profiles)
    with Instance(options.instance or f"{system.name}-field") as instance:
        config = FieldConfig(
            system=str(options.system.resolve()),
            run_dir=str(instance.dir),
            prototype=str(options.prototype_file.resolve()) if options.prototype_file else "",
            profiles=tuple(str(p.resolve()) for p in options.profiles),
            recordings={d: str(Path(p).resolve()) for d, p in options.recordings.items()},
            speed=options.speed,
            listen=options.listen,
            control=options.control,
            token=options.token,
        )
        process = FieldProcess(config, resolve(config, system))
        return await process.run(lambda side: _say(side, process, options))


def _say(side: FieldSimulator, process: FieldProcess, options: FieldOptions) -> None:
    stderr.print(f"[bold]field simulator[/bold] of {side.system.name}")
    for bus, endpoint in side.listening.items():
        devices = ", ".join(d.name for d in side.system.devices_on(bus))
        stderr.print(f"  {bus}: {endpoint}  ({devices})", soft_wrap=True)
    for name, emulated in side.devices.items():
        stderr.print(f"  {name}: from {emulated.plays}", soft_wrap=True)
        for remark in emulated.remarks:
            stderr.print(f"  {name}: {remark}", soft_wrap=True, markup=False)
    for device, endpoint in side.far.items():
        stderr.print(f"  topside end of {device}: {endpoint}", soft_wrap=True)
    host = options.control.rpartition(":")[0]
    where = (
        "" if host in ("", "127.0.0.1", "localhost") and process.control_port == 7420 else f":{process.control_port}"
    )
    here = "localhost" if host in ("", "127.0.0.1", "localhost") else "THIS-HOST"
    system = _word(side.system.name, options)
    stderr.print(f"  now: fieldtwin run {system} --prototype --field {here}{where}", soft_wrap=True, markup=False)


def _word(name: str, options: FieldOptions) -> str:
    """Return the word by which the user can name the system in another command: its bare name if that finds this file from
    every folder, else the path. The name of a folder finds the file only from the present working directory.
    """
    try:
        if (
            not Path(name).is_dir()
            and find("systems", name, extra=options.profiles).resolve() == options.system.resolve()
        ):
            return name
    except UsageError:
        pass
    return shlex.quote(str(options.system))
