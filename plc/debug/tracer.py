"""Stops a running program at breakpoints and steps, with the trace function of Python.

The compiled code of Structured Text has the files and lines of its source, so each line that Python executes in such a file is a
line of the source. All other code runs without being traced.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import Enum
from types import CodeType, FrameType
from typing import Any

from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.plc.debug.breakpoints import Breakpoint
from fieldtwin.plc.st.native.suspension import resume, suspend

MAX_FRAMES = 100
"""How many frames of a call stack are shown."""
_BODIES = ("f_", "a_", "m_", "g_", "s_")
"""How the names of functions, actions, methods, and the GET and SET of properties begin in the compiled code."""


class Resume(Enum):
    """How a stopped program goes on."""

    CONTINUE = "continue"
    NEXT = "next"
    STEP_IN = "stepIn"
    STEP_OUT = "stepOut"


class SessionEnded(BaseException):
    """Ends the program when the user ends the session. It is not an `Exception`, so that no code of the program catches it."""


@dataclass(slots=True)
class StoppedFrame:
    """A frame of a stopped program. `changes` are new values of its local names, which it takes when it goes on.

    Python accepts new values only for the local names of the frame that stopped at a line (`settable`).
    """

    frame: FrameType
    settable: bool
    changes: dict[str, Any] = field(default_factory=dict)

    @property
    def code(self) -> CodeType:
        return self.frame.f_code

    @property
    def space(self) -> dict[str, Any]:
        """Return the global names of the compiled unit."""
        return self.frame.f_globals

    @property
    def local(self) -> Mapping[str, Any]:
        """Return the local names with their values."""
        return {**self.frame.f_locals, **self.changes}


Stopped = Callable[[str, str], None]
"""Called with the reason of a stop (breakpoint, step, pause or exception) and a text about it."""
Logged = Callable[[FrameType, str], None]
"""Called with the frame at a logpoint and its message."""


class Tracer:
    """The control of one program.

    `stopped` and `logged` are called while the program is at the line; `wait` returns when it may go on.
    """

    def __init__(self, stopped: Stopped, logged: Logged, wait: Callable[[], Resume]) -> None:
        self.files: frozenset[str] = frozenset()
        """The names of the files of the source."""
        self.breakpoints: dict[str, Mapping[int, Breakpoint]] = {}
        """By file and line."""
        self.declarations: Mapping[str, set[int]] = {}
        """By file: the lines with initial values of variables, at which only a breakpoint stops."""
        self.frames: list[StoppedFrame] = []
        """While the program is stopped: the frames of the source, the innermost first."""
        self.stop_on_errors = True
        self.stop_on_failures = True
        """Whether the program stops at a failed assertion, which `failed` reports."""
        self.ending = False
        """Whether the program ends at its next line."""
        self._stopped, self._logged, self._wait = stopped, logged, wait
        self._frames = 0
        """The number of frames of the source on the stack."""
        self._step: Resume | None = None
        self._depth = 0
        """The number of frames where the present step began."""
        self._pausing = False
        self._error: object = None

    def run(self, work: Callable[[], None]) -> None:
        """Run `work` under control. Returns when it has ended, also because of `ending`."""
        self.begin()
        try:
            work()
        except SessionEnded:
            return
        finally:
            self.pass_by()

    def begin(self) -> None:
        """Control the code that this thread calls from now on."""
        self._frames = 0
        suspend(self)  # machine code has no lines
        sys.settrace(self._call)

    def pass_by(self) -> None:
        """Control no code of this thread any more, until `begin`."""
        sys.settrace(None)
        resume(self)

    @property
    def needed(self) -> bool:
        """Return whether anything could stop the program or write a message."""
        return self._pausing or self._step is not None or self.stop_on_errors or any(self.breakpoints.values())

    def pause(self) -> None:
        """Stop at the next line of the source."""
        self._pausing = True

    def failed(self, text: str) -> None:
        """Stop at the statement of the source that has called the caller of this, because its assertion has failed."""
        frame: FrameType | None = sys._getframe(1)
        while frame is not None and not self._is_shown(frame):
            frame = frame.f_back
        if self.stop_on_failures and frame is not None:
            self._stop(frame, "exception", text, settable=False)

    def release(self) -> None:
        """Stop nowhere any more."""
        self.breakpoints = {}
        self._pausing = self.stop_on_errors = self.stop_on_failures = False
        self._step = None

    def _call(self, frame: FrameType, event: str, arg: Any) -> Callable[..., Any] | None:
        if not self._is_shown(frame):
            return None
        self._frames += 1
        return self._line

    def _is_shown(self, frame: FrameType) -> bool:
        """Return whether a frame executes a body in the source."""
        return frame.f_code.co_filename in self.files and is_body(frame.f_code)

    def _line(self, frame: FrameType, event: str, arg: Any) -> Callable[..., Any]:
        if event == "line":
            line = frame.f_lineno
            # the line of the declaration counts calls only
            found = self._reason(frame, line) if line != frame.f_code.co_firstlineno else None
            if found is not None:
                self._stop(frame, *found)
        elif event == "exception":
            if self.stop_on_errors and arg[1] is not self._error and isinstance(arg[1], Exception):
                self._error = arg[1]
                self._stop(frame, "exception", str(arg[1]))
        elif event == "return":
            self._frames -= 1
        return self._line

    def _reason(self, frame: FrameType, line: int) -> tuple[str, str] | None:
        """Return why the program stops at a line, and a text about it; None to go on."""
        if self.ending:
            raise SessionEnded
        file = frame.f_code.co_filename
        at = self.breakpoints.get(file)
        if at and line in at and (hit := self._hit(at[line], frame)) is not None:
            return hit
        if line in self.declarations.get(file, ()):
            return None
        if self._pausing:
            return "pause", ""
        steps = {
            Resume.STEP_IN: True,
            Resume.NEXT: self._frames <= self._depth,
            Resume.STEP_OUT: self._frames < self._depth,
        }
        return ("step", "") if self._step is not None and steps[self._step] else None

    def _hit(self, found: Breakpoint, frame: FrameType) -> tuple[str, str] | None:
        pou = pou_key(frame.f_code)
        try:
            if not found.reached(pou, frame):
                return None
        except UsageError as e:
            return "breakpoint", str(e)
        if not found.message:
            return "breakpoint", ""
        self._logged(frame, found.text(pou, frame))
        return None

    def _stop(self, frame: FrameType, reason: str, text: str, *, settable: bool = True) -> None:
        """Wait until the program may go on. `settable`: whether Python takes over new values for the local names of `frame`."""
        self._pausing, self._step = False, None
        at: FrameType | None = frame
        while at is not None and len(self.frames) < MAX_FRAMES:
            if self._is_shown(at):
                self.frames.append(StoppedFrame(at, settable=settable and at is frame))
            at = at.f_back
        innermost = self.frames[0]
        self._stopped(reason, text)
        how = self._wait()
        self.frames.clear()
        if self.ending:
            raise SessionEnded
        self._step = how if how is not Resume.CONTINUE else None
        self._depth = self._frames
        if innermost.changes:
            frame.f_locals.update(innermost.changes)  # Python takes them over when the trace function returns

    def step_first(self) -> None:
        """Stop at the first line of the source."""
        self._step = Resume.STEP_IN


def is_body(code: CodeType) -> bool:
    """Return whether code is the body of a POU, an action or a method, and not a declaration."""
    return code.co_name == "execute" or code.co_name[:2] in _BODIES


def pou_key(code: CodeType) -> str:
    """Return the name of the POU in lower case to which code belongs; for a method or property ``pou.method`` or
    ``pou.property.get``."""
    *owner, name = code.co_qualname.split(".")
    if not owner:
        return _plain(name)
    of = _plain(owner[-1])
    if name == "execute":
        return of
    accessor = {"g_": ".get", "s_": ".set"}.get(name[:2], "")
    return f"{of}.{name[2:]}{accessor}"


def _plain(name: str) -> str:
    """Return the name of a POU without the letter that the compiler writes before it, and with the dots of a full name."""
    return name[2:].replace("\u00b7", ".")


def lines_of(code: CodeType) -> set[int]:
    """Return the lines of the bodies in `code`, at which a program can stop."""
    found = {line for _, _, line in code.co_lines() if line} if is_body(code) else set()
    if is_body(code):
        found.discard(code.co_firstlineno)
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            found |= lines_of(constant)
    return found


def bodies_of(code: CodeType) -> list[CodeType]:
    """Return the code of the bodies in `code`."""
    inner = [body for constant in code.co_consts if isinstance(constant, CodeType) for body in bodies_of(constant)]
    return [code, *inner] if is_body(code) else inner
