"""The configuration of a PLC process: one JSON document, created by the process that starts it.

This module converts frozen dataclasses to JSON and back. It must not depend on a system file, a device or a bus.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.core.image.image import ImageLayout
from fieldtwin.plc.binding import BoundProgram, InputBinding, load_program
from fieldtwin.plc.cycle.start import StartPolicy


@dataclass(frozen=True, slots=True)
class ProgramConfig:
    """The configuration of a program.

    It holds its source (`fieldtwin.plc.binding.load_program`), its bindings from variable to tag, its task (the first task if
    empty), its policy while it waits for its inputs, and the dialect and the libraries of its source. With `takes_writes`,
    servers write its variables; with `machine_code`, it is compiled to machine code. `published` are paths of members and
    elements of its variables, such as ``timer.Q``, that alarms use and that therefore have tags.
    """

    name: str
    source: str
    inputs: dict[str, InputBinding] = field(default_factory=dict)
    outputs: dict[str, str] = field(default_factory=dict)
    task: str = ""
    start: StartPolicy = field(default_factory=StartPolicy)
    dialect: str = "standard"
    libraries: tuple[str, ...] = ()
    takes_writes: bool = False
    machine_code: bool = False
    published: tuple[str, ...] = ()

    def bind(self, python_path: tuple[str, ...] = (), together: dict[Any, Any] | None = None) -> BoundProgram:
        """Create the program (`fieldtwin.plc.binding.load_program`). Raises `FileInvalid`."""
        program = load_program(
            self.source,
            python_path,
            together,
            self.dialect,
            self.libraries,
            takes_writes=self.takes_writes,
            machine_code=self.machine_code,
            published=self.published,
        )
        return BoundProgram(self.name, program, self.inputs, self.outputs)


@dataclass(frozen=True, slots=True)
class TaskSpec:
    """A task (IEC 61131-3, 6.8.2): every `interval_ms`, or once at each rising edge of the tag `single`.

    `priority` 0 is the highest. `late_ms` is the permitted delay of a scan's start; 0 stands for the value of the PLC.
    """

    name: str
    interval_ms: float = 0.0
    priority: int = 10
    single: str = ""
    late_ms: float = 0.0


@dataclass(frozen=True, slots=True)
class PlcConfig:
    """The configuration of a PLC process.

    `layout` is the result of `ImageLayout.describe()`; `image_path` is a file that holds a formatted image with this layout.
    Inputs are BAD when the gateway's last publication is older than `heartbeat_limit_ms`. `priority` is that of SCHED_FIFO; 0
    leaves the process in the normal scheduling class. `python_path` lists folders that are searched first for programs. Without
    `tasks` there is one task, with `cycle_ms`. A scan of more than `stuck_ms` is ended by force (0: never). After that, or after
    a stop by the watchdog, the programs start again `restart_after_ms` later, at most `max_restarts` times in a row.
    `retain_path`: the file of retained variables, ``""`` for none; with `cold` they begin with their initial values.
    `outputs_first`: outputs are published at the start of the cycle. `audit_path`: the file that records what users do to the
    PLC, ``""`` for none. `users`: by tag, what uses variables of programs, such as ``alarm high``, so that an online change must
    not remove them.
    """

    image_path: str
    layout: dict[str, Any]
    control_path: str
    programs: tuple[ProgramConfig, ...]
    cycle_ms: float = 10.0
    late_ms: float = 5.0
    stop_after: int = 3
    heartbeat_limit_ms: float = 1000.0
    priority: int = 10
    python_path: tuple[str, ...] = ()
    tasks: tuple[TaskSpec, ...] = ()
    stuck_ms: float = 0.0
    restart_after_ms: float = 1000.0
    max_restarts: int = 3
    retain_path: str = ""
    cold: bool = False
    outputs_first: bool = False
    audit_path: str = ""
    users: dict[str, list[str]] = field(default_factory=dict)

    def image_layout(self) -> ImageLayout:
        return ImageLayout.from_description(self.layout)

    def to_json(self) -> bytes:
        """Return the configuration as JSON; the inverse of `from_json`."""
        return msgspec.json.format(msgspec.json.encode(self), indent=2)

    @classmethod
    def from_json(cls, text: bytes, path: str = "") -> PlcConfig:
        """Read a configuration from JSON. Raises `FileInvalid` for any other content."""
        try:
            return msgspec.json.decode(text, type=cls)
        except msgspec.MsgspecError as e:
            raise FileInvalid(f"not the configuration of a PLC: {e}", path=path) from e

    @classmethod
    def load(cls, path: Path) -> PlcConfig:
        """Read a configuration from a file. Raises `FileInvalid`."""
        try:
            return cls.from_json(path.read_bytes(), str(path))
        except OSError as e:
            raise FileInvalid(f"cannot read: {e.strerror or e}", path=str(path)) from e
