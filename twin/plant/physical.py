"""The physical twin: gateway and PLC of a system, and the memory that they share.

This module creates, once, everything on which both processes must agree: the process image's layout from the system file, the
file that holds the image, and the configuration of each process. This module does not depend on emulators (`fieldtwin run
--plant` works without that folder).
"""

from __future__ import annotations

import mmap
import os
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from fieldtwin.gateway.connections.sockets.listeners import TcpListener
from fieldtwin.gateway.core.clock import Clock
from fieldtwin.gateway.core.connection import Connector, Listen
from fieldtwin.gateway.core.errors import FieldtwinError, FileInvalid, Unreachable
from fieldtwin.gateway.core.files.error_collector import ErrorCollector, collecting
from fieldtwin.gateway.core.files.nearest import did_you_mean
from fieldtwin.gateway.core.files.profile import Tag
from fieldtwin.gateway.core.image.image import Image, ImageLayout, TagKind, TagSpec, message_tag
from fieldtwin.gateway.devices.canopen_device import CanopenDriver
from fieldtwin.gateway.devices.config import DeviceConfig
from fieldtwin.gateway.devices.register_device import RegisterDriver
from fieldtwin.gateway.runtime.alarms.alarm_list import AlarmConfig
from fieldtwin.gateway.runtime.audit_log import AuditLog
from fieldtwin.gateway.runtime.gateway import Gateway, GatewayConfig, make_driver
from fieldtwin.gateway.runtime.mailboxes.acked_commands import AckedCommandStore
from fieldtwin.gateway.runtime.plc_variables import WRITES, writes_tag
from fieldtwin.gateway.runtime.tags import TagTable
from fieldtwin.gateway.store.exchange_log import ExchangeLog
from fieldtwin.plc.binding import BoundProgram, InputBinding, check_kind, image_for
from fieldtwin.plc.cycle.start import StartPolicy
from fieldtwin.plc.program import Role, Variable
from fieldtwin.plc.runtime.config import PlcConfig, ProgramConfig, TaskSpec
from fieldtwin.twin.plant.alarms import load_alarms
from fieldtwin.twin.plant.names import members_in_alarms, variable_users
from fieldtwin.twin.site.schema import StartForm
from fieldtwin.twin.site.system import System

MESSAGE_DEPTH = 16
MAX_WARNINGS = 8
"""How many unbound inputs of a program have a warning each; more have one together."""
PLC_LOST_CYCLES = 50
"""The PLC's outputs are ignored when it has not published for this many cycles, and for at least `PLC_LOST_MS`."""
PLC_LOST_MS = 500
GATEWAY_LOST_MS = 1000
MIN_STUCK_MS = 200
IDLE_CYCLE_MS = 100
"""The cycle of a PLC without programs, which only publishes its heartbeat."""
PLC_CONFIG = "plc.json"
"""The file in the run directory that holds the configuration of the PLC process."""


def fastest_ms(system: System) -> int:
    """Return the interval of the PLC's fastest cyclic task, which is how often gateway and PLC publish."""
    intervals = [task.interval_ms for task in system.plc.tasks.values() if task.interval_ms]
    return min(intervals, default=system.plc.cycle_ms)


def plc_lost_ms(system: System) -> int:
    """Return the age in ms of the last scan at which the PLC counts as lost and its outputs are set to safe values."""
    return max(PLC_LOST_MS, PLC_LOST_CYCLES * fastest_ms(system))


def gateway_lost_ms(system: System) -> int:
    """Return the age in ms of the last publication at which the gateway counts as dead and all its values as bad."""
    return max(GATEWAY_LOST_MS, 10 * fastest_ms(system))


def _kind(tag: Tag) -> TagKind:
    if tag.type == "bool":
        return TagKind.BOOL
    return TagKind.INT if tag.is_integer else TagKind.REAL


def plant_tags(system: System) -> dict[str, TagSpec]:
    """Return every tag of the system that a process image can hold: numbers, messages and mailboxes."""
    specs: dict[str, TagSpec] = {}

    def add(spec: TagSpec) -> None:
        specs[spec.name] = spec

    for device in system.devices.values():
        profile = device.profile
        for tag in profile.tags.values():
            if not tag.is_text:
                name = f"{device.name}.{tag.name}"
                add(TagSpec(name, _kind(tag), tag.unit, limits=tag.limits, value_names=tag.values))
        for message in profile.messages.values():
            add(message_tag(f"{device.name}.{message.name}", 2 * message.at.count, MESSAGE_DEPTH))
        if profile.inbox is not None and profile.outbox is not None:
            add(message_tag(f"{device.name}.inbox", profile.inbox.bytes, MESSAGE_DEPTH))
            add(message_tag(f"{device.name}.outbox", profile.outbox.bytes, MESSAGE_DEPTH))
    return specs


def programs_of(system: System) -> tuple[ProgramConfig, ...]:
    """Return the configuration of the PLC's programs for its process."""
    written, members = _written_programs(system), members_in_alarms(system)
    return tuple(
        ProgramConfig(
            name,
            form.source,
            {v: InputBinding(i.tag, i.if_bad) for v, i in form.inputs.items()}
            | ({WRITES: InputBinding(writes_tag(name).name)} if name in written else {}),
            dict(form.outputs),
            form.task or "",
            _start_policy(form.start or system.plc.start),
            form.dialect,
            tuple(form.libraries),
            takes_writes=name in written,
            machine_code=form.machine_code,
            published=members.get(name, ()),
        )
        for name, form in system.plc.programs.items()
    )


def _written_programs(system: System) -> frozenset[str]:
    """Return the programs whose variables clients of servers write."""
    written = (tag.variable for server in system.serving.serve for tag in server.tags if tag.variable)
    return frozenset(variable.partition(".")[0] for variable in written)


def program_warnings(system: System) -> tuple[str, ...]:
    """Return the compiler's warnings about the programs of a system, each once. Raises `FileInvalid`."""
    folder = (str(system.path.parent),)
    texts = [config for config in programs_of(system) if config.source.partition(":")[0].strip() != "python"]
    programs = [config.bind(folder).program for config in texts]
    unbound = [
        warning
        for config, program in zip(texts, programs, strict=True)
        for warning in _unbound(config, program.variables.values())
    ]
    return tuple(dict.fromkeys([*(warning for program in programs for warning in program.source_warnings), *unbound]))


def _unbound(config: ProgramConfig, variables: Iterable[Variable]) -> Iterator[str]:
    """Yield warnings about the located inputs of a program that are bound to no tag: one for each, or one for all of many."""
    found = [v for v in variables if v.role is Role.INPUT and v.located and v.name not in config.inputs]
    if len(found) > MAX_WARNINGS:
        named = ", ".join(v.name for v in found[:MAX_WARNINGS])
        yield (
            f"the inputs {named} and {len(found) - MAX_WARNINGS} more of program {config.name} are bound to no tag, so they "
            "keep their initial values"
        )
        return
    for v in found:
        address = v.address or "at an address without a number"
        yield f"input {v.name} ({address}) of program {config.name} is bound to no tag, so it keeps its initial value"


def _start_policy(form: StartForm) -> StartPolicy:
    return StartPolicy(float(form.timeout_ms), form.at_timeout)


def image_layout(system: System) -> ImageLayout:
    """Return the process image of a system: the tags to which its programs are bound, and every other numeric tag, for
    processes that only read the image.
    """
    errors = ErrorCollector()
    bound = bound_programs(system, errors)
    errors.raise_all()
    plant = plant_tags(system) | {tag.name: tag for tag in map(writes_tag, _written_programs(system))}
    watched = [
        f"{d.name}.{t.name}"
        for d in system.devices.values()
        for t in d.profile.tags.values()
        if t.readable and not t.is_text
    ]
    watched += [form.single for form in system.plc.tasks.values() if form.single]
    try:
        return image_for(bound, plant, dict.fromkeys(watched))
    except FileInvalid as e:
        at = next(
            (("plc", "tasks", n, "single") for n, t in system.plc.tasks.items() if e.got and t.single == e.got), None
        )
        raise system.file.error(at or ("plc", "programs"), e.message, expected=e.expected, got=e.got) from e


def bound_programs(system: System, errors: ErrorCollector) -> list[BoundProgram]:
    """Create the programs of a system, and check each name to which their variables are bound.

    Errors are added to `errors`; the result contains the programs that could be created.
    """
    _check_tasks(system, errors)
    bound = []
    for config in programs_of(system):
        try:
            bound.append(config.bind((str(system.path.parent),)))
        except FieldtwinError as e:
            for one in (e, *(e.others if isinstance(e, FileInvalid) else ())):
                errors.add(system.file.error(("plc", "programs", config.name, "source"), str(one)))
    plant = plant_tags(system)
    for program in bound:
        _check_variables(system, program, errors)
        _check_kinds(system, program, plant, errors)
    published = {program.name: [tag for _, tag in program.published()] for program in bound}
    for program in bound:
        for variable, binding in program.inputs.items():
            source = binding.tag.partition(".")[0]
            if variable == WRITES:
                continue
            if source in published and source not in system.devices and binding.tag not in published[source]:
                error = system.file.error(
                    ("plc", "programs", program.name, "inputs", variable, "tag"),
                    f"program {source!r} publishes no {binding.tag!r}",
                    expected=", ".join(published[source]),
                    hint=did_you_mean(binding.tag, published[source]),
                )
                errors.add(error)
    return bound


def alarms_of(system: System, errors: ErrorCollector | None = None) -> tuple[AlarmConfig, ...]:
    """Return the configuration of a system's alarms. Raises `FileInvalid`; with `errors`, the errors are added to it."""
    if not system.alarms:
        return ()
    with collecting(errors) as collector:
        return load_alarms(system, bound_programs(system, collector), collector)


def _check_tasks(system: System, errors: ErrorCollector) -> None:
    """Check that every program's task exists and that at least one task is cyclic: cyclic tasks evaluate the triggers
    of the SINGLE tasks.
    """
    names = list(system.plc.tasks) or ["main"]
    for program, form in system.plc.programs.items():
        if form.task and form.task not in names:
            at = ("plc", "programs", program, "task")
            error = system.file.error(
                at, f"no task {form.task!r}", expected=", ".join(names), hint=did_you_mean(form.task, names)
            )
            errors.add(error)
    if system.plc.tasks and all(form.single for form in system.plc.tasks.values()):
        error = system.file.error(("plc", "tasks"), "only SINGLE tasks", expected="at least one with interval_ms")
        errors.add(error)


def _check_kinds(system: System, bound: BoundProgram, plant: Mapping[str, TagSpec], errors: ErrorCollector) -> None:
    """Check that each variable fits the tag of a device to which it is bound."""
    inputs = {name: binding.tag for name, binding in bound.inputs.items()}
    for key, role, names in (("inputs", Role.INPUT, inputs), ("outputs", Role.OUTPUT, bound.outputs)):
        for variable in bound.variables(role):
            tag = names.get(variable.name, "")
            if tag in plant:
                try:
                    check_kind(bound.name, variable, plant[tag])
                except FileInvalid as e:
                    at = ("plc", "programs", bound.name, key, variable.name, *(("tag",) if role is Role.INPUT else ()))
                    errors.add(system.file.error(at, e.message, expected=e.expected, got=e.got, hint=e.hint))


def _check_variables(system: System, bound: BoundProgram, errors: ErrorCollector) -> None:
    """Check that every name that the file binds is a variable of the program with the right role."""
    for key, role, names in (("inputs", Role.INPUT, bound.inputs), ("outputs", Role.OUTPUT, bound.outputs)):
        declared = [v.name for v in bound.variables(role)]
        for name in names:
            if name not in declared:
                error = system.file.error(
                    ("plc", "programs", bound.name, key, name),
                    f"program {bound.name!r} has no {role.value} {name!r}",
                    expected=", ".join(declared) or "none",
                    hint=did_you_mean(name, declared),
                )
                errors.add(error)


def gateway_config(
    system: System,
    *,
    allow_writes: bool,
    read_only: Collection[str] = (),
    free_ports: bool = False,
    true_silences: bool | None = None,
    delegated: Sequence[str] = (),
    alarms: tuple[AlarmConfig, ...] = (),
) -> GatewayConfig:
    """Return the gateway's configuration. With `allow_writes` it may write to the devices of all buses but `read_only`.

    With `free_ports` it serves and bridges on free ports, so that several gateways can run on one host. Without
    `true_silences` no serial line checks the pauses in RTU frames, because pauses on virtual ports carry no information;
    `free_ports` implies this by default. The mailboxes of the transmitters in `delegated` are delegated to a digital thread.
    """
    true_silences = not free_ports if true_silences is None else true_silences
    serving = system.serving.for_run(allow_writes=allow_writes, read_only=read_only, free_ports=free_ports)
    outputs = {tag for form in system.plc.programs.values() for tag in form.outputs.values()}
    return GatewayConfig(
        buses={name: replace(bus, strict=bus.strict and true_silences) for name, bus in system.buses.items()},
        devices={n: _without_inbox(d) if n in delegated else d for n, d in system.devices.items()},
        cycle_ms=fastest_ms(system),
        plc_lost_ms=plc_lost_ms(system),
        outputs=frozenset(outputs),
        log_tags=frozenset(f"{name}.log" for name in system.plc.programs),
        allow_writes=allow_writes,
        read_only=frozenset(read_only),
        remote=system.remote == "remote",
        serve=serving.serve,
        bridges=serving.bridges,
        delegated=frozenset(delegated),
        alarms=alarms,
    )


def _without_inbox(device: DeviceConfig) -> DeviceConfig:
    return replace(device, poll={group: ms for group, ms in device.poll.items() if group != "inbox"})


def plc_config(system: System, run_dir: Path, *, cold: bool = False) -> PlcConfig:
    """Return the configuration of the PLC process. With `cold` its retained variables start with their initial values."""
    watchdog = system.plc.watchdog
    return PlcConfig(
        image_path=str(run_dir / "image"),
        layout=image_layout(system).describe(),
        control_path=str(run_dir / "plc.sock"),
        audit_path=str(run_dir / "audit.jsonl"),
        programs=programs_of(system),
        cycle_ms=float(fastest_ms(system) if system.plc.programs else IDLE_CYCLE_MS),
        late_ms=float(watchdog.late_ms),
        stop_after=watchdog.stop_after,
        heartbeat_limit_ms=float(gateway_lost_ms(system)),
        python_path=(str(system.path.parent),),
        tasks=tuple(
            TaskSpec(name, float(form.interval_ms or 0), form.priority, form.single or "", float(form.late_ms or 0))
            for name, form in system.plc.tasks.items()
        ),
        stuck_ms=float(watchdog.stuck_ms or max(MIN_STUCK_MS, 20 * fastest_ms(system))),
        restart_after_ms=float(watchdog.restart_after_ms),
        max_restarts=watchdog.restarts,
        retain_path=str(run_dir / "retain"),
        cold=cold,
        outputs_first=system.plc.outputs_at == "start",
        users=variable_users(system),
    )


def layout_in(run_dir: Path, system: System) -> ImageLayout:
    """Return the layout of the process image in `run_dir`, as the PLC's configuration there states it.

    It is not computed from the programs' files, which may have other variables by now. `system` is used if there is no PLC.
    """
    config = run_dir / PLC_CONFIG
    return PlcConfig.load(config).image_layout() if config.exists() else image_layout(system)


def make_image(layout: ImageLayout, path: Path) -> None:
    """Create the file that holds the image, readable and writable for its owner only. It replaces an older one."""
    temporary = path.with_suffix(".new")
    try:
        with open(os.open(temporary, os.O_RDWR | os.O_CREAT | os.O_TRUNC, 0o600), "r+b") as file:
            file.truncate(layout.size)
            with mmap.mmap(file.fileno(), layout.size) as mapped, memoryview(mapped) as memory:
                layout.format(memory)
        temporary.replace(path)
    except OSError as e:
        raise Unreachable(f"cannot make the process image: {e.strerror or e}", where=str(path)) from e


@contextmanager
def attached(layout: ImageLayout, path: Path) -> Iterator[Image]:
    """Map the image file and yield the attached image, which is closed at the end of the block."""
    try:
        with path.open("r+b") as file:
            mapped = mmap.mmap(file.fileno(), 0)
    except (OSError, ValueError) as e:
        raise Unreachable(f"cannot map the process image: {e}", where=str(path)) from e
    with mapped, memoryview(mapped) as memory, layout.attach(memory) as image:
        yield image


def make_drivers(system: System, tags: TagTable, clock: Clock) -> dict[str, RegisterDriver | CanopenDriver]:
    """Return the driver of every device, in the file's order, not attached to a bus yet."""
    return {d.name: make_driver(d, system.buses[d.bus], tags, clock) for d in system.devices.values()}


class EmbeddedControlSystem:
    """The paper's EmbeddedControlSystem: the drivers and the control logic of a system, built from its file alone.

    The plant and its prototype run this same class. It spans two processes, the gateway with the drivers and the PLC
    with the control logic, which share the process image. This class makes the gateway and the configuration of both
    processes.
    """

    def __init__(self, system: System) -> None:
        self.system = system
        self.control_logic: tuple[ProgramConfig, ...] = programs_of(system)
        self.layout: ImageLayout = image_layout(system)
        self.alarms = alarms_of(system)

    def gateway(
        self,
        connector: Connector,
        clock: Clock,
        image: Image,
        audit: AuditLog,
        log: ExchangeLog,
        *,
        allow_writes: bool,
        read_only: Collection[str] = (),
        free_ports: bool = False,
        true_silences: bool | None = None,
        listen: Listen = TcpListener.open,
        delegated: Sequence[str] = (),
        taken: AckedCommandStore | None = None,
    ) -> Gateway:
        """Return the gateway with its drivers.

        The gateway does not know which connections `connector` opens, or where `listen` accepts clients. `taken`
        records which commands need not be passed on again after a restart; None if there will be no restart.
        """
        config = gateway_config(
            self.system,
            allow_writes=allow_writes,
            read_only=read_only,
            free_ports=free_ports,
            true_silences=true_silences,
            delegated=delegated,
            alarms=self.alarms,
        )
        return Gateway(config, connector, clock, image, audit, log, listen, taken)

    def command_lists(self, clock: Clock) -> dict[str, frozenset[str]]:
        """Return the commands that the driver of each device can send."""
        return {name: d.command_list for name, d in make_drivers(self.system, TagTable(clock), clock).items()}

    def prepare(self, run_dir: Path, *, cold: bool = False) -> PlcConfig:
        """Create the process image in `run_dir` and return the PLC process's configuration.

        With `cold`, retained values are discarded.
        """
        make_image(self.layout, run_dir / "image")
        return plc_config(self.system, run_dir, cold=cold)


class PhysicalTwin:
    """The paper's PhysicalTwin: sensors, transmitters and the embedded control system.

    The devices are external hardware; this class holds their description from the system file. CANopen nodes count as
    sensors (paper.md, ruling 13).
    """

    def __init__(self, system: System) -> None:
        self.ecs = EmbeddedControlSystem(system)
        self.sensors = {n: d for n, d in system.devices.items() if d.profile.inbox is None}
        self.transmitters = {n: d for n, d in system.devices.items() if d.profile.inbox is not None}
