"""Start a scenario's simulated field devices and a user's control program, for that scenario alone.

`fieldtwin test --with -- CMD` uses it. The program finds the devices in its environment, as under `fieldtwin with`. Its
standard output goes to standard error, because results go to standard output.
"""

from __future__ import annotations

import asyncio
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path

import msgspec

from fieldtwin.gateway.core.concurrency.async_resource import AsyncResource
from fieldtwin.gateway.core.errors import FieldtwinError, UsageError
from fieldtwin.run.processes.children import Child, ChildFailed
from fieldtwin.run.processes.field_contact import contact_local
from fieldtwin.run.processes.with_program import END_WITHIN_S, FIELD_LINGER_S, environment
from fieldtwin.twin.plant.child import end_with_parent
from fieldtwin.twin.plant.instance import Instance
from fieldtwin.twin.prototype.field_process import FieldConfig, resolve_files
from fieldtwin.twin.site.resolved import write_resolved
from fieldtwin.twin.site.system import System

POLL_S = 0.02
STANDARD_ERROR = 2


class ControllerEnded(FieldtwinError):
    """Raised when the user's control program ended during the test."""


class WithController(AsyncResource):
    """The field simulator and the user's program: ``async with WithController(system, config, argv, name) as both``.

    `name` is the run directory's; it is removed at the end. Raises `UsageError` for a program that does not exist,
    before anything starts.
    """

    def __init__(self, system: System, config: FieldConfig, argv: Sequence[str], name: str) -> None:
        super().__init__()
        self.instance = Instance(name)
        self.env: dict[str, str] = {}
        """The environment variables that give the program the endpoints of the devices."""
        self._system = system
        self._config = config
        self._argv = list(argv)
        self._child: Child | None = None
        self._process: subprocess.Popen[bytes] | None = None

    async def _start(self) -> None:
        program = shutil.which(self._argv[0])
        if program is None:
            raise UsageError(
                f"cannot start {self._argv[0]!r}: no such program", hint="check that it is on the PATH and executable"
            )
        self._stack.enter_context(self.instance)
        home = self.instance.dir
        self._stack.push(partial(_remove, home))
        resolved = write_resolved(self.instance.path("prototype.pickle"), *resolve_files(self._config, self._system))
        path = self.instance.path("field.json")
        path.write_bytes(
            msgspec.json.encode(msgspec.structs.replace(self._config, run_dir=str(home), resolved=resolved))
        )
        path.chmod(0o600)
        child = self._child = Child("field", "fieldtwin.twin.prototype.field_process", path, home, FIELD_LINGER_S)
        self._stack.push_async_callback(child.end)
        contact = await contact_local(await child.connect(), self._system, home)
        self._stack.push_async_callback(contact.aclose)
        self.env = environment(contact, self._system, child.socket)
        self._process = self._spawned(program)
        self._stack.push_async_callback(self._end_program)

    def _spawned(self, program: str) -> subprocess.Popen[bytes]:
        sys.stdout.flush()
        try:
            return subprocess.Popen(
                [program, *self._argv[1:]],
                env={**os.environ, **self.env},
                stdin=subprocess.DEVNULL,
                stdout=STANDARD_ERROR,
                start_new_session=True,
                preexec_fn=partial(end_with_parent, os.getpid()),  # the child process ends when its parent is killed
            )
        except OSError as e:
            raise UsageError(f"cannot start {self._argv[0]!r}: {e.strerror or e}") from e

    def failure(self) -> FieldtwinError | None:
        """Return the reason why the field simulator or the program has ended, or None while both run."""
        assert self._child is not None
        assert self._process is not None
        if (failed := self._child.failure()) is not None:
            return failed
        code = self._process.poll()
        if code is None:
            return None
        how = f"by signal {-code}" if code < 0 else f"with exit status {code}"
        return ControllerEnded(
            f"the controller ended early {how}",
            where=self._argv[0],
            expected="a program that runs until it is stopped",
        )

    async def _end_program(self) -> None:
        """Send SIGTERM to the program and its children in its session, and SIGKILL after `END_WITHIN_S` seconds."""
        process = self._process
        assert process is not None
        deadline_s = asyncio.get_running_loop().time() + END_WITHIN_S
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid, signal.SIGTERM)
        while process.poll() is None and asyncio.get_running_loop().time() < deadline_s:
            await asyncio.sleep(POLL_S)
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid, signal.SIGKILL)
        await asyncio.to_thread(process.wait)


def _remove(home: Path, kind: type[BaseException] | None, error: BaseException | None, at: object) -> None:
    # otherwise the log of the field simulator contains the reason
    if kind is None or not issubclass(kind, ChildFailed):
        shutil.rmtree(home, ignore_errors=True)
