"""The values of a PLC's tags, read from the process image.

The PLC answers on the thread that executes the scans, so a list of thousands of values would delay a scan. The image is shared
memory: reading it costs the PLC nothing, however many tags there are. The PLC itself is asked for its brief status only.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from contextlib import ExitStack
from math import isfinite
from pathlib import Path
from typing import Any

from msgspec import structs

from fieldtwin.capture.decoding.exchange import SECRET
from fieldtwin.gateway.core.image.image import INPUTS, OUTPUTS, RegionReader
from fieldtwin.gateway.core.values import Quality, Reason, TagValue
from fieldtwin.plc.runtime.config import PlcConfig
from fieldtwin.plc.status import PlcStatus, WholePlcStatus
from fieldtwin.twin.plant.physical import attached

CONFIG = "plc.json"
"""The configuration with which the run started its PLC: it holds the layout and the path of the process image."""


class PlcValues:
    """The process image of a run. `read` opens it when it is first needed; `close` gives it back.

    `secrets` are the tags whose values are masked.
    """

    def __init__(self, run_dir: Path, secrets: Collection[str]) -> None:
        self._config = run_dir / CONFIG
        self._secrets = secrets
        self._stack = ExitStack()
        self._readers: tuple[RegionReader, RegionReader] | None = None

    def close(self) -> None:
        """Close the image. The next `read` opens it again."""
        self._readers = None
        self._stack.close()

    def read(self, brief: PlcStatus, programs: Mapping[str, Any], now_ns: int) -> WholePlcStatus:
        """Return a brief status with the present values. `programs`: the PLC's answer to `about`.

        Raises `FileInvalid` or `Unreachable` if the image cannot be read.
        """
        inputs, outputs = (reader.snapshot() for reader in self._readers or self._open())
        values = {tag: self._shown(tag, outputs.values[n]) for tag, n in outputs.shape.index.items()}
        return WholePlcStatus(
            **structs.asdict(brief),
            inputs={
                tag: _input(brief, inputs.value(n)).describe(now_ns) | {"value": self._shown(tag, inputs.values[n])}
                for tag, n in inputs.shape.index.items()
            },
            outputs=values,
            variables={
                f"{program}.{name}": values.get(about["tag"])
                for program, described in programs.items()
                for name, about in described["variables"].items()
                if about["role"] != "input"
            },
        )

    def _shown(self, tag: str, value: Any) -> Any:
        return SECRET if tag in self._secrets else _plain(value)

    def _open(self) -> tuple[RegionReader, RegionReader]:
        config = PlcConfig.load(self._config)
        image = self._stack.enter_context(attached(config.image_layout(), Path(config.image_path)))
        self._readers = image.reader(INPUTS), image.reader(OUTPUTS)
        return self._readers


def _input(plc: PlcStatus, seen: TagValue) -> TagValue:
    """Return an input with the quality that it has for the programs: bad while no program reads it or the gateway is dead."""
    if plc.state == "stopped":
        return TagValue(seen.value, Quality.BAD, Reason.NOT_OPERATIONAL, seen.t_ns)
    if not plc.gateway_alive:
        return TagValue(seen.value, Quality.BAD, Reason.GATEWAY_DEAD, seen.t_ns)
    return seen


def _plain(value: Any) -> Any:
    """Return a value as JSON can hold it: None for a number that is not finite."""
    return None if isinstance(value, float) and not isfinite(value) else value
