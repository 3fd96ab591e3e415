"""Find the scenario files of a system, and run one of them as a child process: ``fieldtwin test FILE --json``."""

from __future__ import annotations

import asyncio
import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from fieldtwin.gateway.core.errors import EndpointBusy, FieldtwinError, UsageError
from fieldtwin.gateway.core.files.yaml_file import load
from fieldtwin.scenarios.language.file_name import SUFFIX, case_of
from fieldtwin.studio.child_run import ChildRun
from fieldtwin.studio.scenarios.progress import RunProgress

MOST_FILES = 200
MOST_FILE_BYTES = 1 << 20
LOOK_EVERY_S = 0.1
TARGETS = ("virtual", "local")
PROGRESS, REPORT = "progress", "report.html"
"""Files in the folder of a run, next to its trace. The name of a trace ends with ``.jsonl``."""


@dataclass(frozen=True)
class KnownScenario:
    """A scenario file. `path` names it in requests; `steps` is its number of steps."""

    path: str
    title: str
    steps: int


def known_scenarios(system: Path, folder: Path) -> list[KnownScenario]:
    """Return the scenarios of a system: those in its folder and in `folder` that name it, at most `MOST_FILES`."""
    places = list(dict.fromkeys([folder.resolve(), system.resolve().parent]))
    files = [file for place in places for file in sorted(place.glob(f"*{SUFFIX}"))]
    return [known for file in files[:MOST_FILES] if (known := _known(file, system)) is not None]


def _known(file: Path, system: Path) -> KnownScenario | None:
    try:
        if not file.is_file() or file.stat().st_size > MOST_FILE_BYTES:
            return None
        data = load(file).data
    except (OSError, FieldtwinError):
        return None  # `fieldtwin test` reports the errors in such a file
    if not isinstance(data, dict) or not _names(str(data.get("system", "")), file, system):
        return None
    steps = data.get("steps")
    return KnownScenario(str(file), str(data.get("scenario", "")), len(steps) if isinstance(steps, list) else 0)


def _names(named: str, file: Path, system: Path) -> bool:
    """Return whether the key `system` of a file names this system file: by its path, or by the name of a shipped system."""
    beside = file.parent / named
    if beside.is_file():
        return beside.resolve() == system.resolve()
    return named.removesuffix(".yaml") == system.name.removesuffix(".yaml")


class ScenarioRunner:
    """Runs one scenario at a time. Use it as ``async with ScenarioRunner() as runner``; leaving the block stops the run."""

    def __init__(self) -> None:
        self._run: _Run | None = None
        self._count = 0
        self._starting = asyncio.Lock()

    async def __aenter__(self) -> ScenarioRunner:
        return self

    async def __aexit__(self, *error: object) -> None:
        await self.stop()
        if self._run is not None:
            self._run.forget()

    def state(self, values_from: int = 0) -> dict[str, Any] | None:
        """Return the present or the latest run, None if there was none. Its values begin with number `values_from`."""
        return self._run.state(values_from) if self._run is not None else None

    async def start(self, path: str, target: str) -> None:
        """Start a scenario. Raises `EndpointBusy` while another one runs."""
        if target not in TARGETS:
            raise UsageError("the target", expected=" or ".join(TARGETS), got=repr(target[:40]))
        async with self._starting:  # of two requests at the same instant, the second finds the first running
            if self._run is not None and self._run.is_running:
                raise EndpointBusy(
                    "a scenario is running already", got=self._run.path, hint="stop it, or wait for its end"
                )
            folder = Path(tempfile.mkdtemp(prefix="fieldtwin-scenario-"))
            trace = folder / f"{case_of(Path(path))}.jsonl" if target == "virtual" else None
            files = ["--progress", str(folder / PROGRESS), "--html", str(folder / REPORT)]
            files += ["--trace", str(trace)] if trace is not None else []
            run = await ChildRun.started(["test", path, "--target", target, "--json", *files], _result)
            if self._run is not None:
                self._run.forget()
            self._count += 1
            self._run = _Run(self._count, path, target, run, folder, trace)

    @property
    def trace(self) -> Path | None:
        """Return the trace of the present or latest run, None if it has none. It is deleted when another one starts."""
        return self._run.trace if self._run is not None else None

    @property
    def report(self) -> Path | None:
        """Return the HTML report of the latest run, None if it has not ended or wrote none."""
        return self._run.report if self._run is not None else None

    async def stop(self) -> None:
        """Stop the run, if one is running."""
        if self._run is not None:
            await self._run.stop()


class _Run:
    """A run whose files are in `folder`: its progress, report and trace."""

    def __init__(self, number: int, path: str, target: str, run: ChildRun, folder: Path, trace: Path | None) -> None:
        self.path = path
        self.trace = trace
        self._number = number
        self._target = target
        self._run = run
        self._folder = folder
        self._progress = RunProgress(folder / PROGRESS)
        self._following = asyncio.ensure_future(self._follow())

    @property
    def is_running(self) -> bool:
        return not self._following.done()

    def state(self, values_from: int) -> dict[str, Any]:
        return {
            "number": self._number,
            "path": self.path,
            "target": self._target,
            "running": self.is_running,
            "elapsed_s": self._run.elapsed_s,
            "trouble": self._run.trouble,
            "result": self._run.result,
            "report": self.report is not None,
            "progress": self._progress.state(values_from),
        }

    @property
    def report(self) -> Path | None:
        path = self._folder / REPORT
        return path if not self.is_running and path.is_file() else None

    def forget(self) -> None:
        """Delete the files of a run that has ended."""
        shutil.rmtree(self._folder, ignore_errors=True)

    async def _follow(self) -> None:
        while self._run.is_running:
            self._progress.look()
            await asyncio.sleep(LOOK_EVERY_S)
        while self._progress.look():
            pass

    async def stop(self) -> None:
        """Interrupt the run, and kill it with its processes if it does not end."""
        await self._run.stop()
        await asyncio.gather(self._following, return_exceptions=True)


def _result(output: bytes) -> dict[str, Any]:
    [result] = msgspec.json.decode(output, type=list[dict[str, Any]])
    return result
