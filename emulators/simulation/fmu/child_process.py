"""The child process that runs an FMU: ``python -m fieldtwin.emulators.simulation.fmu.child_process READ_FD WRITE_FD``.

An FMU is native code, which may crash or never return. This process is therefore the only one that loads it, and it ends at the
first failure. The process that started it limits the time of each step.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from contextlib import suppress
from ctypes import byref
from typing import Any

import msgspec

from fieldtwin.emulators.simulation.fmu.messages import FmuAnswer, FmuLoad, FmuScalar, FmuStep, receive, send

MAX_LOG = 300
"""The number of characters of the FMU's last log message that an error contains."""


class LoadedFmu:
    """An FMU in this process. Its methods raise the exceptions of FMPy."""

    def __init__(self) -> None:
        self.last_log = ""
        """The last message that the FMU has logged."""
        self._callbacks: Any = None
        self._fmu: Any = None

    def load(self, load: FmuLoad) -> None:
        """Load the FMU, instantiate it and initialize it at 0 s."""
        self._inputs = _by_type(load.inputs)
        self._outputs = _by_type(load.outputs)
        self._count = len(load.outputs)
        common = {
            "guid": load.token,
            "modelIdentifier": load.identifier,
            "unzipDirectory": load.folder,
            "instanceName": load.instance,
        }
        self._fmu = self._instantiated_2(common) if load.fmi == 2 else self._instantiated_3(common)
        for scalar, value in load.start:
            self._set(scalar.suffix, [scalar.reference], [value])
        if load.fmi == 2:
            self._fmu.setupExperiment(startTime=0.0)
            self._fmu.enterInitializationMode()
        else:
            self._fmu.enterInitializationMode(startTime=0.0)
        self._fmu.exitInitializationMode()

    def step(self, step: FmuStep) -> list[float]:
        """Set the inputs, do the step, and return the outputs."""
        if step.step_s > 0:
            for suffix, (references, places) in self._inputs.items():
                self._set(suffix, references, [step.inputs[place] for place in places])
            ended = self._fmu.doStep(step.t_s, step.step_s)
            if ended is not None and ended[1]:  # fmi3DoStep: terminateSimulation
                raise RuntimeError("the FMU asks for the end of the simulation")
        values = [0.0] * self._count
        for suffix, (references, places) in self._outputs.items():
            for place, value in zip(places, getattr(self._fmu, f"get{suffix}")(references), strict=True):
                values[place] = float(value)
        return values

    def _set(self, suffix: str, references: list[int], values: list[float]) -> None:
        is_float = suffix in ("Real", "Float64", "Float32")
        getattr(self._fmu, f"set{suffix}")(references, values if is_float else [round(value) for value in values])

    def _instantiated_2(self, common: dict[str, Any]) -> Any:
        from fmpy import calloc, fmi2, free

        callbacks = self._callbacks = fmi2.fmi2CallbackFunctions()
        callbacks.logger = fmi2.fmi2CallbackLoggerTYPE(lambda *said: self._log(said[-1]))
        callbacks.allocateMemory = fmi2.fmi2CallbackAllocateMemoryTYPE(calloc)
        callbacks.freeMemory = fmi2.fmi2CallbackFreeMemoryTYPE(free)
        with suppress(ImportError, OSError):  # native code, which FMPy does not have for every platform
            from fmpy.logging import addLoggerProxy

            addLoggerProxy(byref(callbacks))
        fmu = fmi2.FMU2Slave(**common)
        fmu.instantiate(callbacks=callbacks)
        return fmu

    def _instantiated_3(self, common: dict[str, Any]) -> Any:
        from fmpy import fmi3

        fmu = fmi3.FMU3Slave(**common)
        fmu.instantiate(logMessage=lambda *said: self._log(said[-1]))
        return fmu

    def _log(self, message: bytes | None) -> None:
        self.last_log = (message or b"")[: 4 * MAX_LOG].decode("utf-8", "replace").strip()[:MAX_LOG]


def _by_type(scalars: list[FmuScalar]) -> dict[str, tuple[list[int], list[int]]]:
    """Return the value references of each type, and their places in `scalars`: FMI has a function for each type."""
    found: dict[str, tuple[list[int], list[int]]] = {}
    for place, scalar in enumerate(scalars):
        references, places = found.setdefault(scalar.suffix, ([], []))
        references.append(scalar.reference)
        places.append(place)
    return found


def serve(read: Callable[[int], bytes], to: int) -> None:
    """Load the FMU that the first message names, and do steps until the other process ends or the FMU fails."""
    fmu = LoadedFmu()
    try:
        fmu.load(msgspec.msgpack.decode(receive(read), type=FmuLoad))
        send(to, FmuAnswer())
        while data := receive(read):
            send(to, FmuAnswer(fmu.step(msgspec.msgpack.decode(data, type=FmuStep))))
    except Exception as e:  # FMPy raises plain exceptions; the reason goes to the simulation
        log = f"; the FMU says: {fmu.last_log}" if fmu.last_log else ""
        with suppress(OSError):
            send(to, FmuAnswer(error=f"{e}{log}"))


def main(argv: list[str]) -> None:
    """Run the process. It ends without calling the FMU again, whose code may be damaged."""
    source, to = int(argv[0]), int(argv[1])
    serve(lambda count: os.read(source, count), to)
    os._exit(0)


if __name__ == "__main__":
    main(sys.argv[1:])
