"""The configurations of a run's child processes, made from the options of the run, and the record of the run."""

from __future__ import annotations

import os
from collections.abc import Collection
from pathlib import Path
from typing import TYPE_CHECKING

from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.northbound.process_config import ServerProcessConfig
from fieldtwin.run.live.options import RunOptions
from fieldtwin.run.processes.run_record import RunRecord
from fieldtwin.twin.plant.controller import ControllerConfig
from fieldtwin.twin.plant.mapping import mapping_to_json
from fieldtwin.twin.site.serving import SeparateServer
from fieldtwin.twin.site.system import System
from fieldtwin.twin.thread.place import delegated_transmitter
from fieldtwin.twin.thread.plant_thread import PlantThreadConfig

if TYPE_CHECKING:
    from fieldtwin.twin.prototype.field_process import FieldConfig

MODEM_EVERY_S = 1.0
"""Minimum time in seconds between two values of a tag that the digital thread sends over a modem (some 30 events a second)."""


def transmitter_of_thread(o: RunOptions, system: System) -> str:
    """Return the transmitter whose mailboxes the digital thread uses, or "". Raises `UsageError` if it cannot use them."""
    delegated = delegated_transmitter(o.thread, system)
    if delegated and not o.prototype and not o.allow_writes:
        raise UsageError(
            f"a thread over {delegated!r} writes into its mailbox",
            expected="--allow-writes",
            got=f"--thread {o.thread}",
        )
    if delegated and o.commands:
        raise UsageError(
            f"the topside end of {delegated!r} belongs to the digital twin", expected="--commands none",
            hint="`fieldtwin twin ... --command 1` commands over the thread",
        )  # fmt: skip
    return delegated


def read_only_buses(o: RunOptions, system: System, real: Collection[str], delegated: str) -> tuple[str, ...]:
    """Return the buses to which a prototype run may not write: without --allow-writes, those that the prototype file sets to
    `plant` (`real`). Raises `UsageError` if no bus is real and writes to real devices are allowed, or if the transmitter
    `delegated`, into whose mailbox the digital thread writes, is on a read-only bus.
    """
    if o.allow_writes and not real:
        raise UsageError(
            "--allow-writes needs --plant, or a bus that the prototype file sets to `plant`",
            hint="emulators always accept writes",
        )
    read_only = () if o.allow_writes else tuple(sorted(real))
    if delegated and system.devices[delegated].bus in read_only:
        raise UsageError(
            f"a thread over {delegated!r} writes into its mailbox, and the prototype file sets its bus to `plant`",
            expected="--allow-writes",
            got=f"--thread {o.thread}",
        )
    return read_only


def field_config(o: RunOptions, system: System, run_dir: Path) -> FieldConfig:
    """Return the configuration of the field simulator."""
    from fieldtwin.twin.prototype.field_process import FieldConfig  # here, because a plant has no emulators installed

    listen = dict(o.listen)
    if o.can:
        listen |= {name: f"can:{o.can}" for name, bus in system.buses.items() if bus.endpoint.is_can}
    return FieldConfig(
        system=str(system.path.resolve()),
        run_dir=str(run_dir),
        prototype=str(o.prototype_file.resolve()) if o.prototype_file else "",
        profiles=tuple(str(p.resolve()) for p in o.profiles),
        recordings={d: str(Path(p).resolve()) for d, p in o.recordings.items()},
        speed=o.speed,
        listen=listen,
        seed=o.seed,
        water=o.water,
    )


def gateway_config(
    o: RunOptions,
    system: System,
    run_dir: Path,
    *,
    mapping: dict[Endpoint, Endpoint],
    read_only: tuple[str, ...],
    capture: Path | None,
    delegated: str,
    resolved: str,
) -> ControllerConfig:
    """Return the configuration of the gateway, which writes to no device of the buses in `read_only`. `delegated` names the
    transmitter that the digital thread uses, if any."""
    return ControllerConfig(
        system=str(system.path.resolve()),
        run_dir=str(run_dir),
        allow_writes=o.prototype or o.allow_writes,
        read_only=read_only,
        mapping=mapping_to_json(mapping) if o.prototype else None,
        fixed_ports=o.fixed_ports,
        profiles=tuple(str(p.resolve()) for p in o.profiles),
        capture=str(capture.resolve()) if capture else "",
        delegated=(delegated,) if delegated else (),
        resolved=resolved,
    )


def server_config(o: RunOptions, run_dir: Path, server: SeparateServer, resolved: str) -> ServerProcessConfig:
    """Return the configuration of the process of a server of tags."""
    free_port = o.prototype and not o.fixed_ports
    return ServerProcessConfig(
        resolved=resolved, run_dir=str(run_dir), server=server.name, free_port=free_port, prototype=o.prototype
    )


def thread_config(
    o: RunOptions, run_dir: Path, *, mapping: dict[Endpoint, Endpoint], delegated: str, resolved: str
) -> PlantThreadConfig:
    """Return the configuration of the plant's side of the digital thread; `delegated` as for `gateway_config`."""
    return PlantThreadConfig(
        resolved=resolved,
        run_dir=str(run_dir),
        place=o.thread,
        store=o.thread_store or str(run_dir / "knowledge.sqlite"),
        prototype=o.prototype,
        mapping=mapping_to_json(mapping) if o.prototype else None,
        every_ms=round(
            1000 * (o.thread_every_s if o.thread_every_s is not None else MODEM_EVERY_S if delegated else 0)
        ),
    )


def run_record(o: RunOptions, system: System, capture: Path | None, started_ns: int, started_utc_ns: int) -> RunRecord:
    """Return the record of a run that starts now, by which other commands find it."""
    return RunRecord(
        system=system.name,
        path=str(system.path.resolve()),
        prototype=o.prototype,
        allow_writes=o.prototype or o.allow_writes,
        started_utc_ns=started_utc_ns,
        started_ns=started_ns,
        pid=os.getpid(),
        capture=str(capture.resolve()) if capture else "",
        field_elsewhere=bool(o.field_host),
        writes_only_simulated=o.prototype and not o.allow_writes,
    )
