"""Start prototypes from Studio, and stop them. Each is a separate `fieldtwin run`, which ends with Studio."""

from __future__ import annotations

import asyncio
import contextlib
import re
import signal
from dataclasses import dataclass
from pathlib import Path

from fieldtwin.gateway.core.errors import EndpointBusy, FileInvalid, Unreachable, UsageError
from fieldtwin.run.processes.run_record import read_record
from fieldtwin.studio import child_process
from fieldtwin.studio.live.instances import GATEWAY_SOCKET, accepts, find_instance
from fieldtwin.twin.plant.instance import capture_path, runtime_root
from fieldtwin.twin.site.data_files import search_path

STARTS_WITHIN_S = 30.0
STOPS_WITHIN_S = 10.0
LOOK_EVERY_S = 0.1
MOST_OUTPUT_BYTES = 16_384
"""Number of bytes at the end of a run's messages that are kept to explain why it did not start."""
MOST_RUNS = 4
MOST_SYSTEMS = 200


@dataclass(frozen=True)
class KnownSystem:
    """A system that can be started. `path` is what `fieldtwin run` takes: a file, or the name of a shipped system."""

    name: str
    path: str
    shipped: bool


def known_systems(folder: Path) -> list[KnownSystem]:
    """Return the systems with a prototype file in a folder and its subfolders, and the shipped ones; at most `MOST_SYSTEMS`."""
    own = [
        KnownSystem(path.name.removesuffix(".prototype.yaml"), str(_system_of(path)), False)
        for path in sorted([*folder.glob("*.prototype.yaml"), *folder.glob("*/*.prototype.yaml")])
        if _system_of(path).is_file()
    ]
    shipped = {
        path.name.removesuffix(".prototype.yaml")
        for place in search_path()
        for path in (place / "systems").glob("*.prototype.yaml")
        if _system_of(path).is_file()
    }
    return [*own, *(KnownSystem(name, name, True) for name in sorted(shipped))][:MOST_SYSTEMS]


def _system_of(prototype: Path) -> Path:
    return prototype.with_name(prototype.name.removesuffix(".prototype.yaml") + ".yaml")


def instance_name(system: Path) -> str:
    """Return a valid name of an instance for a system file with any name."""
    return re.sub(r"[^A-Za-z0-9._-]", "-", system.stem).lstrip("._-")[:40] or "system"


class Launcher:
    """The runs that Studio has started. Use it as ``async with Launcher() as launcher``; leaving the block stops them all."""

    def __init__(self) -> None:
        self._runs: dict[str, _Run] = {}

    async def __aenter__(self) -> Launcher:
        return self

    async def __aexit__(self, *error: object) -> None:
        await asyncio.gather(*(run.stop() for run in self._runs.values()), return_exceptions=True)

    def owns(self, instance: str) -> bool:
        """Return whether Studio has started this instance, and it runs."""
        return instance in self._runs and not self._runs[instance].has_ended

    async def start(self, system: str, instance: str = "") -> str:
        """Start the prototype of a system, and return the name of the instance once its gateway answers.

        Raises `EndpointBusy` if the instance runs already, `UsageError` for too many runs, and `Unreachable` with the run's own
        message if it does not start.
        """
        instance = instance or instance_name(Path(system))
        running = [name for name, run in self._runs.items() if not run.has_ended]
        if len(running) >= MOST_RUNS:
            raise UsageError("too many runs at once", expected=f"at most {MOST_RUNS}", got=", ".join(running))
        found = await find_instance(instance)
        if found is not None and found.running:
            raise EndpointBusy(f"the instance {instance!r} is running already")
        arguments = ["run", system, "--prototype", "--instance", instance, "--capture", str(capture_path(instance))]
        process = await child_process.start(
            *arguments, "--commands", "none", "--log", "text", stderr=asyncio.subprocess.STDOUT
        )
        run = self._runs[instance] = _Run(instance, process)
        try:
            await run.until_ready()
        except BaseException:
            await run.stop()
            raise
        return instance

    async def stop(self, instance: str) -> None:
        """Stop an instance. Raises `UsageError` for one that Studio has not started."""
        run = self._runs.get(instance)
        if run is None or run.has_ended:
            raise UsageError(
                f"Studio has not started {instance!r}, so it does not stop it", hint="press Ctrl-C where it was started"
            )
        await run.stop()


class _Run:
    def __init__(self, instance: str, process: asyncio.subprocess.Process) -> None:
        self._instance = instance
        self._process = process
        self._output = b""
        self._reading = asyncio.ensure_future(self._read())

    @property
    def has_ended(self) -> bool:
        return self._process.returncode is not None

    async def _read(self) -> None:
        assert self._process.stdout is not None
        while chunk := await self._process.stdout.read(4096):
            self._output = (self._output + chunk)[-MOST_OUTPUT_BYTES:]

    async def until_ready(self) -> None:
        run_dir = runtime_root() / self._instance
        try:
            async with asyncio.timeout(STARTS_WITHIN_S):
                while not await self._is_ready(run_dir):
                    if self.has_ended:
                        await self._reading
                        raise Unreachable(f"the run did not start: {self._message()}")
                    await asyncio.sleep(LOOK_EVERY_S)
        except TimeoutError as e:
            raise Unreachable(f"the run did not start within {STARTS_WITHIN_S:g} s: {self._message()}") from e

    async def _is_ready(self, run_dir: Path) -> bool:
        """Return whether this run, not an earlier one, has written its record, and its gateway accepts connections."""
        with contextlib.suppress(FileInvalid):
            record = read_record(run_dir)
            return record is not None and record.pid == self._process.pid and await accepts(run_dir / GATEWAY_SOCKET)
        return False

    def _message(self) -> str:
        lines = self._output.decode(errors="replace").strip().splitlines()
        return " ".join(lines[-5:])[-800:] or "it printed nothing"

    async def stop(self) -> None:
        """Stop the run so that its gateway makes the outputs safe. A run that does not end is killed."""
        if not self.has_ended:
            with contextlib.suppress(ProcessLookupError):
                self._process.send_signal(signal.SIGINT)
            try:
                async with asyncio.timeout(STOPS_WITHIN_S):
                    await self._process.wait()
            except TimeoutError:
                self._process.kill()
                await self._process.wait()
        self._reading.cancel()
        await asyncio.gather(self._reading, return_exceptions=True)
