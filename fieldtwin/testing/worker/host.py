"""The process behind a test run: emulated devices, whole field simulators and stepped programs, created and ended on request.

It uses the control channel's protocol over its standard input and output (docs/reference/pytest-plugin.md lists the commands), so
it may run in another virtual environment or in an image, and it ends with the process that started it. It does not depend
on a test runner.
"""

from __future__ import annotations

import asyncio
import os
import shutil
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

from fieldtwin.__about__ import __version__
from fieldtwin.gateway.core.control import MAX_LINE, ControlServer
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.wallclock import WallClock
from fieldtwin.run.template import ForeignParts, agree
from fieldtwin.testing.worker.bench import WorkerBench, new_folder
from fieldtwin.testing.worker.one_device import DeviceRequest, write_system
from fieldtwin.testing.worker.running_plc import PlcProcesses
from fieldtwin.testing.worker.stepped_program import SteppedProgram
from fieldtwin.twin.prototype.field_process import FieldConfig, resolve_files
from fieldtwin.twin.prototype.file import Prototype
from fieldtwin.twin.site.data_files import find
from fieldtwin.twin.site.system import System, load_system

MOST = 1_000
"""Maximum number of simultaneous benches and programs; the error tells the user to end unused ones."""


class Host:
    """The owner of all benches and programs of a test run. ``await Host().serve()`` handles requests until the standard input
    ends."""

    def __init__(self, *, trust: bool = False) -> None:
        self._trust = trust
        """Whether templates from other sources may run; the user allows it when the tests are started."""
        self._clock = WallClock()
        self._benches: dict[int, WorkerBench] = {}
        self._programs: dict[int, SteppedProgram] = {}
        self._number = 0

    async def serve(self) -> int:
        loop = asyncio.get_running_loop()
        reader = asyncio.StreamReader(limit=MAX_LINE)
        try:
            await loop.connect_read_pipe(lambda: asyncio.StreamReaderProtocol(reader), sys.stdin.buffer)
            transport, protocol = await loop.connect_write_pipe(
                lambda: asyncio.streams.FlowControlMixin(loop=loop), os.fdopen(os.dup(1), "wb")
            )
        except ValueError as e:
            raise UsageError(
                "there is no client on stdin and stdout", expected="pipes, as from a test run", got="a file"
            ) from e
        writer = asyncio.StreamWriter(transport, protocol, None, loop)
        server = ControlServer(self.commands())
        try:
            await server.serve_pipe(reader, writer)
        finally:
            await server.aclose()
            await self.aclose()
        return 0

    async def aclose(self) -> None:
        """End every bench and program that is still open."""
        while self._benches:
            _, bench = self._benches.popitem()
            await bench.aclose()

    def commands(self) -> dict[str, Any]:
        return {
            "hello": self._hello,
            "device": self._device,
            "system": self._system,
            "end": self._end,
            "set": self._set,
            "held": self._held,
            "fault": self._fault,
            "clear": self._clear,
            "exchanges": self._exchanges,
            "control": self._control,
            "image": self._image,
            "steer": self._steer,
            "send": self._send,
            "program": self._program,
            "input": self._input,
            "scan": self._scan,
            "report": self._report,
        }

    # -- field simulators ----------------------------------------------------------------------------------------------------

    async def _hello(self, args: dict[str, Any]) -> dict[str, Any]:
        return {"fieldtwin": __version__, "pid": os.getpid()}

    async def _device(self, args: dict[str, Any]) -> dict[str, Any]:
        """Open one device.

        `args` are the fields of `DeviceRequest`, `profiles` (folders) and `beside` (the test's folder).
        """
        wanted = _wanted(args)
        beside = Path(args["beside"]) if args.get("beside") else None
        profiles = tuple(map(Path, args.get("profiles") or ()))
        folder = new_folder()
        try:
            path = write_system(wanted, folder, profiles, beside)
            return await self._open(folder, *resolve_files(FieldConfig(str(path), str(folder))))
        except BaseException:
            folder_gone(folder)
            raise

    async def _system(self, args: dict[str, Any]) -> dict[str, Any]:
        """Open the field simulator of a system.

        `args` are `system`, `prototype`, `profiles`, `recordings`, `speed` and `listen`, as in `FieldConfig`, `seed`, and
        `beside` (the test's folder).
        """
        name, beside = str(args.get("system", "")), str(args.get("beside") or ".")
        folder = new_folder()
        try:
            own = Path(beside) / name
            path = own if own.is_file() else find("systems", name)
            seed = args.get("seed")
            config = FieldConfig(
                system=str(path.resolve()),
                run_dir=str(folder),
                prototype=str((Path(beside) / args["prototype"]).resolve()) if args.get("prototype") else "",
                profiles=tuple(args.get("profiles") or ()),
                recordings=dict(args.get("recordings") or {}),
                speed=float(args.get("speed") or 0.0),
                listen=dict(args.get("listen") or {}),
            )
            system, prototype = resolve_files(config)
            agree(self._trusts, path, [(system, prototype.path)])
            prototype = prototype if seed is None else replace(prototype, seed=int(seed))
            return await self._open(folder, system, prototype)
        except BaseException:
            folder_gone(folder)
            raise

    async def _open(self, folder: Path, system: System, prototype: Prototype) -> dict[str, Any]:
        number = self._next()
        bench = WorkerBench(system, prototype, self._clock, folder)
        try:
            await bench.open()
        except BaseException:
            await bench.aclose()
            raise
        self._benches[number] = bench
        return {"id": number, **bench.describe()}

    def _next(self) -> int:
        if len(self._benches) + len(self._programs) >= MOST:
            raise UsageError(f"{MOST} at once", hint="end those that are no longer needed")
        self._number += 1
        return self._number

    def _bench(self, args: dict[str, Any]) -> WorkerBench:
        bench = self._benches.get(args.get("id", 0))
        if bench is None:
            raise UsageError(f"no field simulator {args.get('id')!r}", expected="the id that `device` or `system` gave")
        bench.alive()
        return bench

    async def _end(self, args: dict[str, Any]) -> dict[str, Any]:
        number = args.get("id", 0)
        self._programs.pop(number, None)
        bench = self._benches.pop(number, None)
        if bench is not None:
            await bench.aclose()
        return {}

    async def _set(self, args: dict[str, Any]) -> dict[str, Any]:
        self._bench(args).set(str(args.get("device", "")), str(args.get("tag", "")), args.get("value"))
        return {}

    async def _held(self, args: dict[str, Any]) -> Any:
        return self._bench(args).held(str(args.get("device", "")), str(args.get("tag", "")))

    async def _fault(self, args: dict[str, Any]) -> str:
        said = args.get("fault")
        if not isinstance(said, dict):
            raise UsageError("a fault", expected='{"name": ..., "device": ...}', got=repr(said)[:60])
        return self._bench(args).fault(said)

    async def _clear(self, args: dict[str, Any]) -> dict[str, Any]:
        self._bench(args).field.faults.clear(str(args.get("fault", "")))
        return {}

    async def _exchanges(self, args: dict[str, Any]) -> dict[str, Any]:
        log = self._bench(args).log
        found = log.since(int(args.get("since") or 0))
        return {"exchanges": found, "pending": log.pending(), "last": log.number, "now_s": log.now_s}

    # -- gateway and PLC for a field simulator -------------------------------------------------------------------------

    async def _control(self, args: dict[str, Any]) -> dict[str, Any]:
        bench = self._bench(args)
        await bench.control(tuple(args.get("profiles") or ()))
        return {"names": await self._plc(args).names()}

    def _plc(self, args: dict[str, Any]) -> PlcProcesses:
        plc = self._bench(args).plc
        if plc is None:
            raise UsageError("no PLC is running", hint="`control` starts one")
        return plc

    async def _image(self, args: dict[str, Any]) -> dict[str, Any]:
        return await self._plc(args).tag(str(args.get("tag", "")))

    async def _steer(self, args: dict[str, Any]) -> dict[str, Any]:
        return await self._plc(args).steer(str(args.get("do", "")), dict(args.get("args") or {}))

    async def _send(self, args: dict[str, Any]) -> dict[str, Any]:
        self._plc(args).send(int(args.get("period_s") or 0))
        return {}

    # -- programs -------------------------------------------------------------------------------------------------------

    async def _program(self, args: dict[str, Any]) -> dict[str, Any]:
        number = self._next()
        folders, source = tuple(map(str, args.get("folders") or ())), str(args.get("source", ""))
        if args.get("system"):
            source, folders = self._of_system(str(args["system"]), source, folders)
        program = SteppedProgram(source, folders, float(args.get("cycle_ms") or 10.0))
        self._programs[number] = program
        return {"id": number, "values": program.values()}

    def _of_system(self, name: str, program: str, folders: tuple[str, ...]) -> tuple[str, tuple[str, ...]]:
        """Return the source of a program of a system, and the folders in which it is searched."""
        own = next((path for folder in folders if (path := Path(folder) / name).is_file()), None)
        system = load_system(str(own or name))
        if program not in system.plc.programs:
            raise UsageError(f"{system.name} has no program {program!r}", expected=", ".join(system.plc.programs))
        agree(self._trusts, system.path, [(system, None)], plant=True)
        return system.plc.programs[program].source, (str(system.path.parent),)

    def _trusts(self, template: ForeignParts) -> bool:
        return self._trust

    def _stepped(self, args: dict[str, Any]) -> SteppedProgram:
        program = self._programs.get(args.get("id", 0))
        if program is None:
            raise UsageError(f"no program {args.get('id')!r}", expected="the id that `program` gave")
        return program

    async def _input(self, args: dict[str, Any]) -> dict[str, Any]:
        program = self._stepped(args)
        for name, value in dict(args.get("values") or {}).items():
            program.set(name, value, str(args.get("quality") or "good"))
        return {}

    async def _scan(self, args: dict[str, Any]) -> dict[str, Any]:
        program = self._stepped(args)
        if args.get("seconds") is not None:
            scans = max(1, round(float(args["seconds"]) * 1e9 / program.cycle_ns))
        else:
            scans = int(args.get("scans") or 1)
        program.scan(scans)
        return {"values": program.values(), "scans": program.scans, "t_s": program.now_ns / 1e9}

    # -- reports --------------------------------------------------------------------------------------------------------

    async def _report(self, args: dict[str, Any]) -> dict[str, Any]:
        from fieldtwin.testing.worker.report import write_report

        write_report(args)
        return {}


def _wanted(args: dict[str, Any]) -> DeviceRequest:
    known = DeviceRequest.__dataclass_fields__
    said = {key: value for key, value in args.items() if key in known and value is not None}
    unknown = set(args) - set(known) - {"profiles", "beside"}
    if unknown or not said.get("device"):
        raise UsageError("a device", expected="device=NAME, and of " + ", ".join(known), got=", ".join(sorted(unknown)))
    return DeviceRequest(**said)


def folder_gone(folder: Path) -> None:
    """Remove the folder of a bench that failed to open."""
    shutil.rmtree(folder, ignore_errors=True)
