"""A session with an editor: the requests of the Debug Adapter Protocol (version 1.68), and the program that they control.

The program runs in a thread. While it is stopped it waits, so this thread may read its variables.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.errors import FieldtwinError, UsageError
from fieldtwin.run.debug.frames import Units, Variable
from fieldtwin.run.debug.messages import Messages
from fieldtwin.run.debug.programs import Debuggee
from fieldtwin.run.debug.tracer import Resume, Tracer, lines_of

ENDING_S = 5.0
"""How long the end of a session waits for its program, in seconds."""
_THREAD = 1
"""The id of the program's thread in the protocol."""
_CAPABILITIES = {
    "supportsConfigurationDoneRequest": True,
    "supportsTerminateRequest": True,
    "supportsEvaluateForHovers": True,
    "supportsBreakpointLocationsRequest": True,
    "exceptionBreakpointFilters": [{"filter": "errors", "label": "Errors in a scan", "default": True}],
}
Launch = Callable[[dict[str, Any]], Debuggee]
"""Reads and compiles the program for the arguments of a launch request. Raises `FieldtwinError`."""


class Session:
    """One session. `serve` returns when the editor has ended it."""

    def __init__(self, messages: Messages, launch: Launch) -> None:
        self._messages, self._launch = messages, launch
        self._tracer = Tracer(self._on_stop)
        self._debuggee = Debuggee([], lambda say: True)
        self._units = Units([], {})
        self._lines: dict[str, set[int]] = {}
        """By file: the lines at which a program can stop."""
        self._handles: list[tuple[FrameType, Variable | str]] = []
        """The things that the editor may list: a scope ("local" or "global"), or a variable with parts. The number of a handle is
        its place here, from 1.
        """
        self._thread: threading.Thread | None = None
        self._entry = False
        self._ended = False

    def serve(self) -> None:
        """Answer requests until the editor disconnects."""
        while not self._ended and (request := self._messages.receive()) is not None:
            self._answer(request)
        self._tracer.end()
        if self._thread is not None:
            self._thread.join(ENDING_S)

    def _answer(self, request: dict[str, Any]) -> None:
        command = str(request.get("command", ""))
        answer: dict[str, Any] = {"request_seq": request.get("seq", 0), "command": command, "success": True}
        handler = getattr(self, f"_do_{command}", None)
        given = request.get("arguments")
        try:
            if handler is None:
                raise UsageError(f"a request that is not supported: {command}")
            body = handler(given if isinstance(given, dict) else {})
            if body is not None:
                answer["body"] = body
        except FieldtwinError as e:
            lines = [str(e), *(str(other) for other in getattr(e, "others", ()))]
            answer |= {"success": False, "message": "\n".join(lines)}
        except (KeyError, TypeError, ValueError) as e:
            answer |= {"success": False, "message": f"the arguments of {command}: {type(e).__name__}: {e}"}
        self._messages.send("response", **answer)
        if command == "launch" and answer["success"]:
            self._messages.send("event", event="initialized")

    # -- beginning and end ------------------------------------------------------------------------------------------------

    def _do_initialize(self, given: dict[str, Any]) -> dict[str, Any]:
        return _CAPABILITIES

    def _do_launch(self, given: dict[str, Any]) -> None:
        if self._thread is not None:
            raise UsageError("the program has been launched before")
        self._debuggee = self._launch(given)
        self._entry = given.get("stopOnEntry") is True
        self._units = Units(self._debuggee.units, self._debuggee.names)
        for unit in self._debuggee.units:
            for code in unit.code:
                self._lines.setdefault(code.co_filename, set()).update(lines_of(code))
        if given.get("noDebug") is not True:
            self._tracer.files = frozenset(self._lines)

    def _do_configurationDone(self, given: dict[str, Any]) -> None:
        self._thread = threading.Thread(target=self._run, name="debugged program", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        well = False

        def work() -> None:
            nonlocal well
            try:
                well = self._debuggee.run(self._say)
            except FieldtwinError as e:
                self._say(str(e), "stderr")

        self._tracer.run(work, stop_on_entry=self._entry)
        self._messages.send("event", event="exited", body={"exitCode": 0 if well else 1})
        self._messages.send("event", event="terminated")

    def _say(self, line: str, category: str = "stdout") -> None:
        self._messages.send("event", event="output", body={"category": category, "output": f"{line}\n"})

    def _do_terminate(self, given: dict[str, Any]) -> None:
        self._tracer.end()

    def _do_disconnect(self, given: dict[str, Any]) -> None:
        self._ended = True

    # -- breakpoints ------------------------------------------------------------------------------------------------------

    def _do_setBreakpoints(self, given: dict[str, Any]) -> dict[str, Any]:
        source = given["source"]
        file = self._file(str(source.get("path", "")))
        answers: list[dict[str, Any]] = []
        chosen: set[int] = set()
        for one in given.get("breakpoints", ()):
            wanted = int(one["line"])
            line = min((line for line in self._lines.get(file, ()) if line >= wanted), default=None)
            if line is None:
                message = "no statement at or below this line" if file else "this file is not part of the program"
                answers.append({"verified": False, "line": wanted, "message": message})
            else:
                chosen.add(line)
                answers.append({"verified": True, "line": line})
        if file:
            self._tracer.breakpoints = {**self._tracer.breakpoints, file: frozenset(chosen)}
        return {"breakpoints": answers}

    def _do_breakpointLocations(self, given: dict[str, Any]) -> dict[str, Any]:
        file = self._file(str(given["source"].get("path", "")))
        first = int(given["line"])
        last = int(given.get("endLine", first))
        return {"breakpoints": [{"line": n} for n in sorted(self._lines.get(file, ())) if first <= n <= last]}

    def _do_setExceptionBreakpoints(self, given: dict[str, Any]) -> None:
        self._tracer.stop_on_errors = "errors" in given.get("filters", ())

    def _file(self, path: str) -> str:
        """Return the name by which the program knows the file `path`; "" if it is not part of the program."""
        real = os.path.realpath(path)
        return next((file for file in self._lines if os.path.realpath(file) == real), "")

    # -- a stopped program ------------------------------------------------------------------------------------------------

    def _on_stop(self, reason: str, text: str) -> None:
        """Tell the editor that the program has stopped. This is called in the program's thread."""
        frame = self._tracer.frames[0]
        body = {"reason": reason, "threadId": _THREAD, "allThreadsStopped": True, "description": _time_text(frame)}
        if text:
            body["text"] = text
        self._messages.send("event", event="stopped", body=body)

    def _do_threads(self, given: dict[str, Any]) -> dict[str, Any]:
        return {"threads": [{"id": _THREAD, "name": "PLC"}]}

    def _do_stackTrace(self, given: dict[str, Any]) -> dict[str, Any]:
        first, levels = int(given.get("startFrame", 0)), int(given.get("levels", 0))
        frames = self._tracer.frames
        shown = frames[first : first + levels] if levels else frames[first:]
        described = [self._frame(number, frame) for number, frame in enumerate(shown, first + 1)]
        return {"stackFrames": described, "totalFrames": len(frames)}

    def _frame(self, number: int, frame: FrameType) -> dict[str, Any]:
        path = Path(frame.f_code.co_filename)
        source = {"name": path.name, "path": os.path.realpath(path)}
        return {"id": number, "name": self._units.title(frame), "line": frame.f_lineno, "column": 1, "source": source}

    def _do_scopes(self, given: dict[str, Any]) -> dict[str, Any]:
        frame = self._chosen(int(given["frameId"]))
        scopes = [
            {"name": self._units.title(frame), "variablesReference": self._handle(frame, "local"), "expensive": False}
        ]
        if self._units.global_variables(frame):
            scopes.append({"name": "Globals", "variablesReference": self._handle(frame, "global"), "expensive": False})
        return {"scopes": scopes}

    def _do_variables(self, given: dict[str, Any]) -> dict[str, Any]:
        number = int(given["variablesReference"])
        if not 1 <= number <= len(self._handles):
            raise UsageError("these variables no longer exist, because the program has gone on")
        frame, of = self._handles[number - 1]
        if isinstance(of, Variable):
            found = self._units.parts(of, frame)
        else:
            found = self._units.variables(frame) if of == "local" else self._units.global_variables(frame)
        return {"variables": [{"name": one.name, **self._value(one, frame, "value")} for one in found]}

    def _do_evaluate(self, given: dict[str, Any]) -> dict[str, Any]:
        frame = self._chosen(int(given.get("frameId", 1)))
        path = str(given["expression"]).strip()
        found = self._units.find(path, frame)
        if found is None:
            raise UsageError(f"no variable {path!r} here", expected="a path such as timer.ET or levels[3]")
        return self._value(found, frame, "result")

    def _value(self, one: Variable, frame: FrameType, key: str) -> dict[str, Any]:
        return {
            key: one.text,
            "type": str(one.type),
            "variablesReference": self._handle(frame, one) if one.has_parts else 0,
        }

    def _chosen(self, number: int) -> FrameType:
        if not 1 <= number <= len(self._tracer.frames):
            raise UsageError("the program is not stopped there")
        return self._tracer.frames[number - 1]

    def _handle(self, frame: FrameType, of: Variable | str) -> int:
        self._handles.append((frame, of))
        return len(self._handles)

    # -- going on ---------------------------------------------------------------------------------------------------------

    def _resume(self, how: Resume) -> None:
        if not self._tracer.frames:
            raise UsageError("the program is not stopped")
        self._handles.clear()
        self._tracer.resume(how)

    def _do_continue(self, given: dict[str, Any]) -> dict[str, Any]:
        self._resume(Resume.CONTINUE)
        return {"allThreadsContinued": True}

    def _do_next(self, given: dict[str, Any]) -> None:
        self._resume(Resume.NEXT)

    def _do_stepIn(self, given: dict[str, Any]) -> None:
        self._resume(Resume.STEP_IN)

    def _do_stepOut(self, given: dict[str, Any]) -> None:
        self._resume(Resume.STEP_OUT)

    def _do_pause(self, given: dict[str, Any]) -> None:
        self._tracer.pause()


def _time_text(frame: FrameType) -> str:
    """Return the time of the scan of a frame."""
    return f"at {frame.f_globals['_c'].now_ns / NS_PER_S:.3f} s"
