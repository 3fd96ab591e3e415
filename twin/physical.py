"""The physical twin: gateway and PLC of a system, and the memory that they share.

Everything that both processes must agree on is made here, once: the process image's layout from the system file, the file that
holds it, and each process's own configuration. Emulators are unknown (`fieldtwin run --plant` works without that folder).
"""

from __future__ import annotations

import mmap
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from gateway.core.errors import CommandListMismatch, FieldtwinError, FileInvalid, Unreachable
from gateway.core.image import Image, ImageLayout, TagKind, TagSpec, message_tag
from gateway.core.profile import DeviceProfile, Tag
from gateway.devices.driver import DeviceDriver
from gateway.runtime.gateway import GatewayConfig
from plc.binding import BoundProgram, InputBinding, image_for
from plc.config import PlcConfig, ProgramConfig
from plc.program import Role
from twin.system import System

MESSAGE_DEPTH = 16
PLC_LOST_CYCLES = 50
"""The PLC's outputs count no more when it has not published for so many cycles, and for `PLC_LOST_MS` at least."""
PLC_LOST_MS = 500
GATEWAY_LOST_MS = 1000


def _kind(tag: Tag) -> TagKind:
    if tag.type == "bool":
        return TagKind.BOOL
    return TagKind.INT if tag.is_integer else TagKind.REAL


def plant_tags(system: System) -> dict[str, TagSpec]:
    """Every tag of the system that a process image can hold: numbers, messages and mailboxes."""
    specs: dict[str, TagSpec] = {}

    def add(spec: TagSpec) -> None:
        specs[spec.name] = spec

    for device in system.devices.values():
        profile = device.profile
        for tag in profile.tags.values():
            if not tag.is_text:
                add(TagSpec(f"{device.name}.{tag.name}", _kind(tag), tag.unit))
        for message in profile.messages.values():
            add(message_tag(f"{device.name}.{message.name}", 2 * message.at.count, MESSAGE_DEPTH))
        if profile.inbox is not None and profile.outbox is not None:
            add(message_tag(f"{device.name}.inbox", profile.inbox.bytes, MESSAGE_DEPTH))
            add(message_tag(f"{device.name}.outbox", profile.outbox.bytes, MESSAGE_DEPTH))
    return specs


def programs_of(system: System) -> tuple[ProgramConfig, ...]:
    """The PLC's programs as its process wants them."""
    return tuple(
        ProgramConfig(
            name,
            form.source,
            {v: InputBinding(i.tag, i.if_bad) for v, i in form.inputs.items()},
            dict(form.outputs),
        )
        for name, form in system.plc.programs.items()
    )


def image_layout(system: System) -> ImageLayout:
    """The process image of a system: what its programs are bound to, and every other number for watchers."""
    folder = str(system.path.parent)
    plant = plant_tags(system)
    bound = []
    for config in programs_of(system):
        try:
            program = config.bind((folder,))
        except FieldtwinError as e:
            raise system.file.error(("plc", "programs", config.name, "source"), str(e)) from e
        _check_variables(system, program)
        bound.append(program)
    watched = [
        f"{d.name}.{t.name}"
        for d in system.devices.values()
        for t in d.profile.tags.values()
        if t.readable and not t.is_text
    ]
    try:
        return image_for(bound, plant, watched)
    except FileInvalid as e:
        raise system.file.error(("plc", "programs"), e.message, expected=e.expected, got=e.got) from e


def _check_variables(system: System, bound: BoundProgram) -> None:
    """What the file binds must be variables of the program, of the right kind."""
    for key, role, names in (("inputs", Role.INPUT, bound.inputs), ("outputs", Role.OUTPUT, bound.outputs)):
        declared = [v.name for v in bound.variables(role)]
        for name in names:
            if name not in declared:
                raise system.file.error(
                    ("plc", "programs", bound.name, key, name),
                    f"program {bound.name!r} has no {role.value} {name!r}",
                    expected=", ".join(declared) or "none",
                )


def gateway_config(system: System, *, allow_writes: bool) -> GatewayConfig:
    """What the gateway runs."""
    outputs = {tag for form in system.plc.programs.values() for tag in form.outputs.values()}
    return GatewayConfig(
        buses=system.buses,
        devices=system.devices,
        cycle_ms=system.plc.cycle_ms,
        plc_lost_ms=max(PLC_LOST_MS, PLC_LOST_CYCLES * system.plc.cycle_ms),
        outputs=frozenset(outputs),
        log_tags=frozenset(f"{name}.log" for name in system.plc.programs),
        allow_writes=allow_writes,
        remote=system.remote == "remote",
    )


def plc_config(system: System, run_dir: Path) -> PlcConfig:
    """What the PLC process is told."""
    return PlcConfig(
        image_path=str(run_dir / "image"),
        layout=image_layout(system).describe(),
        control_path=str(run_dir / "plc.sock"),
        programs=programs_of(system),
        cycle_ms=float(system.plc.cycle_ms),
        late_ms=float(system.plc.watchdog.late_ms),
        stop_after=system.plc.watchdog.stop_after,
        heartbeat_limit_ms=float(max(GATEWAY_LOST_MS, 10 * system.plc.cycle_ms)),
        python_path=(str(system.path.parent),),
    )


def make_image(layout: ImageLayout, path: Path) -> None:
    """Make the file that holds the image, readable and writable for its owner only. It replaces an older one."""
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
    """Map the image file and attach to it."""
    try:
        with path.open("r+b") as file:
            mapped = mmap.mmap(file.fileno(), 0)
    except (OSError, ValueError) as e:
        raise Unreachable(f"cannot map the process image: {e}", where=str(path)) from e
    with mapped, memoryview(mapped) as memory, layout.attach(memory) as image:
        yield image


@dataclass(frozen=True)
class Communication:
    """SPEC row Communication: a driver and what it talks to accept the same commands, both inclusions."""

    name: str
    driver_commands: frozenset[str]
    device_commands: frozenset[str]

    def check(self) -> None:
        """Raises `CommandListMismatch` that names what is missing on either side."""
        if self.driver_commands == self.device_commands:
            return
        only_driver = ", ".join(sorted(self.driver_commands - self.device_commands)) or "nothing"
        only_device = ", ".join(sorted(self.device_commands - self.driver_commands)) or "nothing"
        raise CommandListMismatch(
            f"device {self.name!r} and its driver differ in their commands",
            expected="the same list on both sides",
            got=f"unknown to the device: {only_driver}; unknown to the driver: {only_device}",
        )


def check_commands(driver: DeviceDriver, device_profile: DeviceProfile) -> None:
    """Refuse a device whose profile accepts other commands than its driver sends."""
    Communication(driver.config.name, driver.command_list, device_profile.command_list).check()
