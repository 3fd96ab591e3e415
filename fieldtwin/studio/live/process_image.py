"""The process image of a run, opened when it is first needed.

Reading the shared memory costs gateway and PLC nothing, however many tags there are.
"""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path

from fieldtwin.gateway.core.image.image import INPUTS, OUTPUTS, RegionReader, Snapshot
from fieldtwin.plc.runtime.config import PlcConfig
from fieldtwin.twin.plant.physical import attached

CONFIG = "plc.json"
"""The configuration with which the run started its PLC: it holds the layout and the path of the process image."""


class ProcessImage:
    """The regions of the image. `inputs` and `outputs` raise `FileInvalid` or `Unreachable` if it cannot be read."""

    def __init__(self, run_dir: Path) -> None:
        self._config = run_dir / CONFIG
        self._stack = ExitStack()
        self._readers: tuple[RegionReader, RegionReader] | None = None

    def close(self) -> None:
        """Close the image. The next reading opens it again."""
        self._readers = None
        self._stack.close()

    def inputs(self) -> Snapshot:
        """Return the latest publication of the gateway."""
        return self._opened()[0].snapshot()

    def outputs(self) -> Snapshot:
        """Return the latest publication of the PLC."""
        return self._opened()[1].snapshot()

    def _opened(self) -> tuple[RegionReader, RegionReader]:
        if self._readers is None:
            config = PlcConfig.load(self._config)
            image = self._stack.enter_context(attached(config.image_layout(), Path(config.image_path)))
            self._readers = image.reader(INPUTS), image.reader(OUTPUTS)
        return self._readers
