"""Run an FMU in a child process, and turn every way in which it can fail into an error that names the FMU and the time.

The caller waits for each answer, in virtual time as well as in real time: the values therefore do not depend on the speed of
the computer. An FMU that does not answer within the limit is killed.
"""

from __future__ import annotations

import math
import os
import select
import signal
import subprocess
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import msgspec

from fieldtwin.emulators.simulation.fmu.description import FmuDescription, FmuVariable, unpack
from fieldtwin.emulators.simulation.fmu.messages import (
    FmuAnswer,
    FmuLoad,
    FmuScalar,
    FmuStep,
    receive,
    send,
)
from fieldtwin.emulators.simulation.fmu.unpacked_folder import UnpackedFolder
from fieldtwin.emulators.virtual.seal import unsealed
from fieldtwin.gateway.core.errors import FileInvalid

CHILD = "fieldtwin.emulators.simulation.fmu.child_process"
START_LIMIT_MS = 60_000
"""The time that loading and initializing an FMU may take, in ms of real time."""
END_LIMIT_S = 2.0
"""The time that a process may take to end after it has closed its connection, in s."""
_CRASHES = (signal.SIGSEGV, signal.SIGBUS, signal.SIGFPE, signal.SIGILL, signal.SIGABRT)
Launch = Callable[..., list[str]]
"""``launch(module, *arguments)``: a function that returns the command line of a child process that ends with this process."""


@dataclass(frozen=True, slots=True)
class FmuBinding:
    """An FMU with the variables that a simulation uses, by the names that the simulation gives them."""

    fmu: FmuDescription
    start: dict[str, float]
    """FMU's variable -> its value before the initialization."""
    inputs: dict[str, str]
    """Name in the simulation -> FMU's variable."""
    outputs: dict[str, str]


class FmuProcess:
    """The child process of one FMU. It starts at the first step. `limit_ms` is the longest real time of a step."""

    def __init__(self, name: str, binding: FmuBinding, limit_ms: int, launch: Launch) -> None:
        self._name = name
        self._binding = binding
        self._limit_ms = limit_ms
        self._launch = launch
        self._process: subprocess.Popen[bytes] | None = None
        self._folder: UnpackedFolder | None = None
        self._to = self._from = -1
        self.failure: FileInvalid | None = None
        """The error after which the FMU does no further step."""

    def step(self, t_s: float, dt_s: float, values: Mapping[str, float]) -> dict[str, float]:
        """Return the outputs at `t_s`, `dt_s` after the previous step. Raises `FileInvalid`, then at every further step."""
        if self.failure is not None:
            raise self.failure
        try:
            if self._process is None:
                self._start()
            inputs = self._inputs(t_s, values) if dt_s > 0 else []
            found = self._ask(FmuStep(t_s - dt_s, dt_s, inputs), self._limit_ms, f"the step to {t_s:g} s")
            return self._checked(t_s, found)
        except FileInvalid as e:
            self.failure = e
            self.close()
            raise

    def close(self) -> None:
        """End the process, and remove the unpacked files."""
        with unsealed():
            if self._process is not None:
                self._process.kill()
                self._process.wait()
            for end in (self._to, self._from):
                if end >= 0:
                    os.close(end)
            self._to = self._from = -1
            if self._folder is not None:
                self._folder.remove()
                self._folder = None
            if self.failure is None:
                self.failure = FileInvalid("the simulation has ended", path=str(self._binding.fmu.path))

    def _start(self) -> None:
        fmu, variables = self._binding.fmu, self._binding.fmu.variables
        with unsealed():
            self._folder = UnpackedFolder()
            unpack(fmu.path, self._folder.path)
            theirs_read, self._to = os.pipe()
            self._from, theirs_write = os.pipe()
            try:
                self._process = subprocess.Popen(
                    self._launch(CHILD, str(theirs_read), str(theirs_write)),
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL,  # the FMU's code may print
                    stderr=subprocess.DEVNULL,
                    pass_fds=(theirs_read, theirs_write),
                    start_new_session=True,  # Ctrl-C reaches the run, which ends the process
                )
            except OSError as e:
                raise self._failed(f"its process cannot be started: {e.strerror or e}") from e
            finally:
                os.close(theirs_read)
                os.close(theirs_write)
        load = FmuLoad(
            folder=str(self._folder.path),
            fmi=fmu.fmi,
            identifier=fmu.identifier,
            token=fmu.token,
            instance=self._name,
            start=[(_scalar(variables[name]), value) for name, value in self._binding.start.items()],
            inputs=[_scalar(variables[name]) for name in self._binding.inputs.values()],
            outputs=[_scalar(variables[name]) for name in self._binding.outputs.values()],
        )
        self._ask(load, START_LIMIT_MS, "the initialization")

    def _inputs(self, t_s: float, values: Mapping[str, float]) -> list[float]:
        for name in self._binding.inputs:
            if not math.isfinite(values[name]):
                raise self._failed(f"the input {name!r} is {values[name]} at {t_s:g} s, which is not a number")
        return [values[name] for name in self._binding.inputs]

    def _checked(self, t_s: float, found: list[float]) -> dict[str, float]:
        for name, value in zip(self._binding.outputs, found, strict=True):
            if not math.isfinite(value):
                raise self._failed(f"the output {name!r} is {value} at {t_s:g} s")
        return dict(zip(self._binding.outputs, found, strict=True))

    def _ask(self, message: FmuLoad | FmuStep, limit_ms: int, doing: str) -> list[float]:
        """Send a message and return the outputs of the answer. `doing` says in errors what the FMU was asked to do."""
        try:
            send(self._to, message)
            data = receive(lambda count: self._read(count, limit_ms, doing))
            answer = msgspec.msgpack.decode(data, type=FmuAnswer) if data else None
        except (OSError, msgspec.MsgspecError):
            answer = None
        if answer is None:
            raise self._failed(f"its process has ended during {doing}: {self._end()}")
        if answer.error:
            raise self._failed(f"{doing} failed: {answer.error}")
        return answer.outputs

    def _read(self, count: int, limit_ms: int, doing: str) -> bytes:
        ready = select.poll()
        ready.register(self._from, select.POLLIN)
        if not ready.poll(limit_ms):
            raise self._failed(f"{doing} took more than {limit_ms} ms of real time, and its process was killed")
        return os.read(self._from, count)

    def _end(self) -> str:
        """Return how the process ended: the signal, or the exit code."""
        assert self._process is not None
        with unsealed():
            try:
                code = self._process.wait(END_LIMIT_S)
            except subprocess.TimeoutExpired:
                return "it closed its connection"
        if code < 0:
            name = next((s.name for s in signal.Signals if s == -code), f"signal {-code}")
            return f"{name}, a crash of its code" if -code in _CRASHES else name
        return f"exit code {code}"

    def _failed(self, text: str) -> FileInvalid:
        return FileInvalid(f"the FMU of the simulation {self._name!r} failed: {text}", path=str(self._binding.fmu.path))


def _scalar(variable: FmuVariable) -> FmuScalar:
    return FmuScalar(variable.reference, variable.suffix)
