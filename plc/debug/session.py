"""A session with an editor: the requests of the Debug Adapter Protocol (version 1.68) about a program, and their answers.

The session has a `Tracer`, which stops the program. While it is stopped, requests may read and set its variables.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from pathlib import Path
from types import CodeType, FrameType
from typing import Any, Protocol

from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.errors import FieldtwinError, UsageError
from fieldtwin.plc.debug.breakpoints import Breakpoint, hit_condition
from fieldtwin.plc.debug.declarations import declaration_lines
from fieldtwin.plc.debug.frames import Units, Variable
from fieldtwin.plc.debug.tracer import Resume, StoppedFrame, Tracer, bodies_of, lines_of, pou_key
from fieldtwin.plc.st import types as ty
from fieldtwin.plc.st.compiler.compile import CompiledUnit

THREAD = 1
"""The id of the program's thread in the protocol."""
CAPABILITIES = {
    "supportsConfigurationDoneRequest": True,
    "supportsTerminateRequest": True,
    "supportsEvaluateForHovers": True,
    "supportsBreakpointLocationsRequest": True,
    "supportsConditionalBreakpoints": True,
    "supportsHitConditionalBreakpoints": True,
    "supportsLogPoints": True,
    "supportsSetVariable": True,
    "supportsSetExpression": True,
    "exceptionBreakpointFilters": [
        {"filter": "errors", "label": "Errors in a scan", "default": True},
        {"filter": "assertions", "label": "Failed assertions of unit tests", "default": True},
    ],
}


class Send(Protocol):
    """Sends a message of type `kind` to the editor: response or event."""

    def __call__(self, kind: str, **more: Any) -> None: ...


class Session:
    """The requests about one program, whose `units` and names are set by `show`. `resume` lets it go on after a stop."""

    def __init__(self, send: Send, tracer: Tracer, resume: Callable[[Resume], None]) -> None:
        self.send, self.tracer = send, tracer
        self._resume_program = resume
        self._units = Units([], {})
        self.started_ns: Callable[[], int] = lambda: 0
        """Returns the time of the program's clock at which the program started, for a program that runs in virtual time."""
        self._code: dict[str, list[CodeType]] = {}
        """By file: the bodies of its POUs."""
        self._lines: dict[str, set[int]] = {}
        """By file: the lines at which a program can stop."""
        self.then: Callable[[], None] | None = None
        """Lets the program go on, after the response to the request: an event of the program must not come before it."""
        self._handles: list[tuple[StoppedFrame, Variable | str]] = []
        """The things that the editor may list: a scope ("local" or "global"), or a variable with parts. The number of a handle is
        its place here, from 1.
        """

    def show(self, units: list[CompiledUnit], names: Mapping[str, str]) -> None:
        """Debug the programs of `units`. `names` are those of POUs that the source does not name, in lower case."""
        self._units = Units(units, names)
        self._code, self._lines = {}, {}
        for unit in units:
            for code in unit.code:
                self._lines.setdefault(code.co_filename, set()).update(lines_of(code))
                self._code.setdefault(code.co_filename, []).extend(bodies_of(code))
        self.tracer.files = frozenset(self._lines)
        self.tracer.declarations = declaration_lines(units)

    def answer(self, request: Mapping[str, Any]) -> None:
        """Send the response to a request."""
        command = str(request.get("command", ""))
        answer: dict[str, Any] = {"request_seq": request.get("seq", 0), "command": command, "success": True}
        handler = getattr(self, f"do_{command}", None)
        given = request.get("arguments")
        try:
            if handler is None:
                raise UsageError(f"a request that is not supported: {command}")
            body = handler(given if isinstance(given, dict) else {})
            if body is not None:
                answer["body"] = body
        except FieldtwinError as e:
            lines = [str(e), *(str(other) for other in getattr(e, "others", ()))]
            answer |= _failure("\n".join(lines))
        except (KeyError, TypeError, ValueError) as e:
            answer |= _failure(f"the arguments of {command}: {type(e).__name__}: {e}")
        self.send("response", **answer)
        then, self.then = self.then, None
        if then is not None:
            then()
        if command in ("launch", "attach") and answer["success"]:
            self.send("event", event="initialized")

    def do_initialize(self, given: dict[str, Any]) -> dict[str, Any]:
        return CAPABILITIES

    def do_configurationDone(self, given: dict[str, Any]) -> None:
        """Accept the end of the configuration. A program that is not running yet starts now."""

    def do_terminate(self, given: dict[str, Any]) -> None:
        """Accept the request to end the program."""

    def do_disconnect(self, given: dict[str, Any]) -> None:
        """Accept the end of the session."""

    def output(self, text: str, category: str = "stdout", **more: Any) -> None:
        """Send a line of text to the editor."""
        self.send("event", event="output", body={"category": category, "output": f"{text}\n", **more})

    def logged(self, frame: FrameType, text: str) -> None:
        """Send the message of a logpoint."""
        # some editors show no output of the category console
        self.output(f"{self._time_text(frame.f_globals)}: {text}", **place(frame.f_code.co_filename, frame.f_lineno))

    # -- breakpoints ------------------------------------------------------------------------------------------------------

    def do_setBreakpoints(self, given: dict[str, Any]) -> dict[str, Any]:
        source = given["source"]
        file = self._file(str(source.get("path", "")))
        answers: list[dict[str, Any]] = []
        chosen: dict[int, Breakpoint] = {}
        for one in given.get("breakpoints", ()):
            wanted = int(one["line"])
            try:
                line = self._place(file, wanted)
                chosen[line] = self._breakpoint(file, line, one)
                answers.append({"verified": True, "line": line})
            except UsageError as e:
                answers.append({"verified": False, "line": wanted, "message": str(e)})
        if file:
            self.tracer.breakpoints = {**self.tracer.breakpoints, file: chosen}
        return {"breakpoints": answers}

    def _place(self, file: str, wanted: int) -> int:
        """Return the line at which a breakpoint at the line `wanted` stops. Raises `UsageError`."""
        if not file:
            raise UsageError("this file is not part of the program")
        lines, declared = self._lines[file], self.tracer.declarations.get(file, set())
        line = min((line for line in lines if line == wanted or (line > wanted and line not in declared)), default=None)
        if line is None:
            raise UsageError("no statement at or below this line")
        return line

    def _breakpoint(self, file: str, line: int, one: dict[str, Any]) -> Breakpoint:
        """Return the breakpoint that an editor describes. Raises `UsageError` if its conditions or its message are not valid."""
        code = {pou_key(body): body for body in self._code[file] if line in lines_of(body)}

        def compile_in(pou: str, text: str, wanted: ty.Type | None) -> Any:
            return self._units.expression(code[pou], text, wanted)

        condition, message = str(one.get("condition") or "").strip(), str(one.get("logMessage") or "")
        found = Breakpoint(compile_in, condition, hit_condition(str(one.get("hitCondition") or "")), message)
        for pou in code:
            found.check(pou)
        return found

    def do_breakpointLocations(self, given: dict[str, Any]) -> dict[str, Any]:
        file = self._file(str(given["source"].get("path", "")))
        first = int(given["line"])
        last = int(given.get("endLine", first))
        return {"breakpoints": [{"line": n} for n in sorted(self._lines.get(file, ())) if first <= n <= last]}

    def do_setExceptionBreakpoints(self, given: dict[str, Any]) -> None:
        chosen = given.get("filters", ())
        self.tracer.stop_on_errors, self.tracer.stop_on_failures = "errors" in chosen, "assertions" in chosen

    def _file(self, path: str) -> str:
        """Return the name by which the program knows the file `path`; "" if it is not part of the program."""
        real = os.path.realpath(path)
        return next((file for file in self._lines if os.path.realpath(file) == real), "")

    # -- a stopped program ------------------------------------------------------------------------------------------------

    def stopped(self, reason: str, text: str) -> None:
        """Tell the editor that the program has stopped."""
        body = {"reason": reason, "threadId": THREAD, "allThreadsStopped": True}
        body["description"] = self._time_text(self.tracer.frames[0].space)
        if text:
            body["text"] = text
        self.send("event", event="stopped", body=body)

    def _time_text(self, space: Mapping[str, Any]) -> str:
        """Return the time of the scan that executes the code with these global names, since the start of the program."""
        return f"at {(space['_c'].now_ns - self.started_ns()) / NS_PER_S:.3f} s"

    def do_threads(self, given: dict[str, Any]) -> dict[str, Any]:
        return {"threads": [{"id": THREAD, "name": "PLC"}]}

    def do_stackTrace(self, given: dict[str, Any]) -> dict[str, Any]:
        first, levels = int(given.get("startFrame", 0)), int(given.get("levels", 0))
        frames = self.tracer.frames
        shown = frames[first : first + levels] if levels else frames[first:]
        described = [self._frame(number, frame) for number, frame in enumerate(shown, first + 1)]
        return {"stackFrames": described, "totalFrames": len(frames)}

    def _frame(self, number: int, frame: StoppedFrame) -> dict[str, Any]:
        title = self._units.title(frame.code)
        return {"id": number, "name": title, "column": 1, **place(frame.code.co_filename, frame.frame.f_lineno)}

    def do_scopes(self, given: dict[str, Any]) -> dict[str, Any]:
        frame = self._chosen(int(given["frameId"]))
        scopes = [
            {
                "name": self._units.title(frame.code),
                "variablesReference": self._handle(frame, "local"),
                "expensive": False,
            }
        ]
        if self._units.global_variables(frame):
            scopes.append({"name": "Globals", "variablesReference": self._handle(frame, "global"), "expensive": False})
        return {"scopes": scopes}

    def do_variables(self, given: dict[str, Any]) -> dict[str, Any]:
        frame, found = self._listed(int(given["variablesReference"]))
        described = [{"name": one.name, "evaluateName": one.path, **self._value(one, frame, "value")} for one in found]
        return {"variables": described}

    def _listed(self, number: int) -> tuple[StoppedFrame, list[Variable]]:
        """Return the frame and the variables that a handle lists."""
        if not 1 <= number <= len(self._handles):
            raise UsageError("these variables no longer exist, because the program has gone on")
        frame, of = self._handles[number - 1]
        if isinstance(of, Variable):
            return frame, self._units.parts(of, frame)
        return frame, self._units.variables(frame) if of == "local" else self._units.global_variables(frame)

    def do_setVariable(self, given: dict[str, Any]) -> dict[str, Any]:
        frame, known = self._listed(int(given["variablesReference"]))
        name = str(given["name"])
        found = next((one for one in known if one.name == name), None)
        if found is None:
            raise UsageError(f"no variable {name!r} here")
        return self._value(self.assigned(found, str(given["value"]), frame), frame, "value")

    def do_setExpression(self, given: dict[str, Any]) -> dict[str, Any]:
        frame = self._chosen(int(given.get("frameId", 1)))
        path = str(given["expression"]).strip()
        found = self._units.find(path, frame)
        if found is None:
            raise UsageError(f"no variable {path!r} here", expected="a path such as timer.PT or levels[3]")
        return self._value(self.assigned(found, str(given["value"]), frame), frame, "value")

    def assigned(self, variable: Variable, text: str, frame: StoppedFrame) -> Variable:
        """Give a variable a new value, and return it with that value. Raises `UsageError`."""
        return self._units.assign(variable, text, frame)

    def do_evaluate(self, given: dict[str, Any]) -> dict[str, Any]:
        frame = self._chosen(int(given.get("frameId", 1)))
        return self._value(self._units.evaluate(str(given["expression"]).strip(), frame), frame, "result")

    def _value(self, one: Variable, frame: StoppedFrame, key: str) -> dict[str, Any]:
        return {
            key: one.text,
            "type": str(one.type),
            "variablesReference": self._handle(frame, one) if one.has_parts else 0,
            **({"presentationHint": {"attributes": ["readOnly"]}} if one.assign is None and not one.has_parts else {}),
        }

    def _chosen(self, number: int) -> StoppedFrame:
        if not 1 <= number <= len(self.tracer.frames):
            raise UsageError("the program is not stopped there")
        return self.tracer.frames[number - 1]

    def _handle(self, frame: StoppedFrame, of: Variable | str) -> int:
        self._handles.append((frame, of))
        return len(self._handles)

    # -- going on ---------------------------------------------------------------------------------------------------------

    def _resume(self, how: Resume) -> None:
        if not self.tracer.frames:
            raise UsageError("the program is not stopped")
        self._handles.clear()
        self.then = lambda: self._resume_program(how)

    def do_continue(self, given: dict[str, Any]) -> dict[str, Any]:
        self._resume(Resume.CONTINUE)
        return {"allThreadsContinued": True}

    def do_next(self, given: dict[str, Any]) -> None:
        self._resume(Resume.NEXT)

    def do_stepIn(self, given: dict[str, Any]) -> None:
        self._resume(Resume.STEP_IN)

    def do_stepOut(self, given: dict[str, Any]) -> None:
        self._resume(Resume.STEP_OUT)

    def do_pause(self, given: dict[str, Any]) -> None:
        self.tracer.pause()


def place(path: str, line: int) -> dict[str, Any]:
    """Return the part of an event or a response that names a line of a file."""
    return {"source": {"name": Path(path).name, "path": os.path.realpath(path)}, "line": line}


def _failure(text: str) -> dict[str, Any]:
    """Return the part of a response that says why a request failed. The body is for editors that do not show the message."""
    return {"success": False, "message": text, "body": {"error": {"id": 1, "format": text}}}
