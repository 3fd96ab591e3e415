"""The commands of the control channel that replace programs while they run: prepare a change, apply it, and go back.

A change is prepared in a thread and a separate process, and applied between two scans. The version before the last change is
kept in memory, so that a user can return to it although the files hold the new one.
"""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any, Protocol, TypeVar

from fieldtwin.gateway.core.errors import Bug, FieldtwinError, UsageError
from fieldtwin.plc.binding import text_source
from fieldtwin.plc.runtime.realtime import after_the_scans
from fieldtwin.plc.runtime.runner import TaskRunner
from fieldtwin.plc.runtime.sources import changed
from fieldtwin.plc.source_files import source_files
from fieldtwin.plc.status import ChangesStatus

T = TypeVar("T")
PYTHON = "its file changed, and a program in Python cannot be replaced while it runs"


class Note(Protocol):
    """The interface of the record of users' actions. It raises `Unreachable` if the action cannot be recorded."""

    def __call__(self, action: str, args: dict[str, Any], **details: Any) -> None: ...


class OnlineChanges:
    """The changes of the programs of one runner. `note` records each change before it is carried out."""

    def __init__(self, runner: TaskRunner, note: Note) -> None:
        self.status = ChangesStatus()
        self._runner = runner
        self._note = note
        self._number = 0
        self._prepared: Any = None  # an OnlineChange, whose module loads the compiler
        self._back = False
        self._before: Mapping[str, Any] = {}
        """By program, the version that ran before the last change; empty before the first change, and after a return."""

    def forget(self) -> None:
        """Forget the version before the last change, because the programs were restarted from their files."""
        self._prepared, self._before = None, {}

    async def prepare(self, args: dict[str, Any]) -> dict[str, Any]:
        """Prepare a change and return its number, and what it does to each program, as data for JSON.

        Raises `FileInvalid` for an invalid source, and `UsageError` for a return without an earlier version.
        """
        self._back = args.get("back") is True
        if self._back and not self._before:
            raise UsageError(
                "there is no earlier version of the programs", expected="a reload that replaced programs before"
            )
        found = await aside(self._prepare_back if self._back else self._prepare_files)
        self._number, self._prepared = self._number + 1, found
        changes = [
            {
                "where": change.path,
                "what": f"plc.programs.{change.program}: {change}",
                "live": not change.refused,
                "kept": change.differences.kept,
                "new": change.differences.new,
                "removed": change.differences.removed,
                "changed": change.differences.changed,
            }
            for change in (found.changes if found is not None else ())
        ]
        if not self._back:
            changes += [
                {"where": s.path, "what": f"plc.programs.{s.program}: {PYTHON}", "live": False}
                for s in changed([source for source in self._runner.sources if not source.compiled])
            ]
        return {"number": self._number, "changes": changes}

    async def apply(self, args: dict[str, Any]) -> dict[str, Any]:
        """Carry out the prepared change after the next scan. Raises `ChangeRefused`, and changes nothing then."""
        change, self._prepared = self._prepared, None
        if change is None or args.get("number") != self._number:
            raise UsageError("no such change is prepared", hint="repeat the command")
        texts = [f"plc.programs.{one.program}: {one}" for one in change.changes]
        before = {} if self._back else change.before
        self._note("change_back" if self._back else "change", args, programs=texts)
        done: asyncio.Future[int] = asyncio.get_running_loop().create_future()

        def commit() -> None:
            error: FieldtwinError | None = None
            try:
                change.commit()
            except FieldtwinError as e:
                error = e
            except Exception as e:  # an error of this project must not end the PLC, which runs as before
                error = Bug(f"the change failed: {type(e).__name__}: {e}")
            else:
                self._before = before
                self.status = ChangesStatus(count=self.status.count + 1, last=texts)
            if done.done():  # the client has gone
                return
            if error is not None:
                done.set_exception(error)
            else:
                done.set_result(self._runner.entries[0].scan.number)

        if self._runner.halted:  # then no scan follows
            commit()
        else:
            self._runner.between_scans(commit)
        return {"scan": await done}

    # -- in a thread ----------------------------------------------------------------------------------------------------

    def _prepare_files(self) -> Any:
        config = self._runner.config
        names = self._changed_programs()
        if not names:
            return None
        from fieldtwin.plc.runtime.online.change import prepare
        from fieldtwin.plc.runtime.online.compiling import CompileRequest, compile_elsewhere

        programs = tuple(p for p in config.programs if p.name in names)
        return prepare(self._runner, compile_elsewhere(CompileRequest(programs, config.python_path)))

    def _prepare_back(self) -> Any:
        from fieldtwin.plc.runtime.online.change import prepare

        return prepare(self._runner, self._before)

    def _changed_programs(self) -> set[str]:
        """Return the programs in Structured Text whose files changed, also if a folder has another file now."""
        compiled = [source for source in self._runner.sources if source.compiled]
        names = {source.program for source in changed(compiled)}
        for config in self._runner.config.programs:
            known = {source.path for source in compiled if source.program == config.name}
            found = text_source(config.source, self._runner.config.python_path) if known else None
            if found is not None and found[0].is_dir() and not known.issuperset(map(str, source_files(found[0]))):
                names.add(config.name)
        return names


async def aside(work: Callable[[], T]) -> T:
    """Do `work` in a thread that lets the scans go first, and that does not keep the process from ending."""
    loop = asyncio.get_running_loop()
    done: asyncio.Future[T] = loop.create_future()

    def ended(result: T | None, error: BaseException | None) -> None:
        if done.cancelled():
            return
        if error is not None:
            done.set_exception(error)
        else:
            done.set_result(result)  # type: ignore[arg-type]

    def run() -> None:
        result, error = None, None
        try:
            with after_the_scans():
                result = work()
        except BaseException as e:  # raised again by the caller
            error = e
        with suppress(RuntimeError):  # the loop is closed, because the process ends
            loop.call_soon_threadsafe(ended, result, error)

    threading.Thread(target=run, daemon=True, name="programs").start()
    return await done
