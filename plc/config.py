"""What a PLC process is told: one JSON document, made by whoever starts it.

Frozen dataclasses to JSON and back. It must never know a system file, a device or a bus.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec

from gateway.core.errors import FileInvalid
from gateway.core.image import ImageLayout
from plc.binding import BoundProgram, InputBinding, load_program
from plc.task import TaskConfig


@dataclass(frozen=True, slots=True)
class ProgramConfig:
    """A program: its source (``python: module:Class``) and its bindings, variable to tag."""

    name: str
    source: str
    inputs: dict[str, InputBinding] = field(default_factory=dict)
    outputs: dict[str, str] = field(default_factory=dict)

    def bind(self, python_path: tuple[str, ...] = ()) -> BoundProgram:
        """Make the program. Raises `FileInvalid`."""
        return BoundProgram(self.name, load_program(self.source, python_path), self.inputs, self.outputs)


@dataclass(frozen=True, slots=True)
class PlcConfig:
    """A PLC process. `layout` is `ImageLayout.describe()`; `image_path` a file that holds a formatted image of it.

    `heartbeat_limit_ms`: age of the gateway's last publication beyond which inputs are BAD. `priority`: of SCHED_FIFO,
    0 to stay in the normal class. `python_path`: folders that programs are searched in first.
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

    def image_layout(self) -> ImageLayout:
        return ImageLayout.from_description(self.layout)

    def task(self) -> TaskConfig:
        return TaskConfig(self.cycle_ms, self.late_ms, self.stop_after)

    def to_json(self) -> bytes:
        """The inverse of `from_json`."""
        return msgspec.json.format(msgspec.json.encode(self), indent=2)

    @classmethod
    def from_json(cls, text: bytes, path: str = "") -> PlcConfig:
        """Raises `FileInvalid` for JSON that is no such configuration."""
        try:
            return msgspec.json.decode(text, type=cls)
        except msgspec.MsgspecError as e:
            raise FileInvalid(f"not the configuration of a PLC: {e}", path=path) from e

    @classmethod
    def load(cls, path: Path) -> PlcConfig:
        """Read a file. Raises `FileInvalid`."""
        try:
            return cls.from_json(path.read_bytes(), str(path))
        except OSError as e:
            raise FileInvalid(f"cannot read: {e.strerror or e}", path=str(path)) from e
