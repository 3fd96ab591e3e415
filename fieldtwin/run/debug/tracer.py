"""Stops a running program at breakpoints and steps, with the trace function of Python.

The compiled code of Structured Text has the files and lines of its source, so each line that Python executes in such a file is a
line of the source. All other code runs without being traced.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from enum import Enum
from queue import SimpleQueue
from types import CodeType, FrameType
from typing import Any

MAX_FRAMES = 100
"""How many frames of a call stack are shown."""


class Resume(Enum):
    """How a stopped program goes on."""

    CONTINUE = "continue"
    NEXT = "next"
    STEP_IN = "stepIn"
    STEP_OUT = "stepOut"


class SessionEnded(BaseException):
    """Ends the program when the user ends the session. It is not an `Exception`, so that no code of the program catches it."""


class Tracer:
    """The control of one program, which runs in a separate thread. `resume`, `pause` and `end` are for other threads."""

    def __init__(self, stopped: Callable[[str, str], None]) -> None:
        """`stopped` is called in the program's thread with the reason of a stop (breakpoint, step, pause or exception) and a text
        about it.
        """
        self.files: frozenset[str] = frozenset()
        """The names of the files of the source."""
        self.breakpoints: dict[str, frozenset[int]] = {}
        """By file: the lines at which to stop."""
        self.frames: list[FrameType] = []
        """While the program is stopped: the frames of the source, the innermost first."""
        self.stop_on_errors = True
        self._stopped = stopped
        self._commands: SimpleQueue[Resume] = SimpleQueue()
        self._frames = 0
        """The number of frames of the source on the stack."""
        self._step: Resume | None = None
        self._depth = 0
        """The number of frames where the present step began."""
        self._pausing = self._ending = False
        self._error: object = None

    def run(self, work: Callable[[], None], *, stop_on_entry: bool) -> None:
        """Run `work` in this thread. Returns when it has ended, also because of `end`."""
        self._step = Resume.STEP_IN if stop_on_entry else None
        sys.settrace(self._call)
        try:
            work()
        except SessionEnded:
            return
        finally:
            sys.settrace(None)

    # -- for other threads ------------------------------------------------------------------------------------------------

    def resume(self, how: Resume) -> None:
        """Let the stopped program go on."""
        self._commands.put(how)

    def pause(self) -> None:
        """Stop at the next line of the source."""
        self._pausing = True

    def end(self) -> None:
        """End the program, at once if it is stopped, else at its next line."""
        self._ending = True
        self._commands.put(Resume.CONTINUE)

    # -- in the program's thread ------------------------------------------------------------------------------------------

    def _call(self, frame: FrameType, event: str, arg: Any) -> Callable[..., Any] | None:
        code = frame.f_code
        if code.co_filename not in self.files or not is_body(code):
            return None
        self._frames += 1
        return self._line

    def _line(self, frame: FrameType, event: str, arg: Any) -> Callable[..., Any]:
        if event == "line":
            line = frame.f_lineno
            # the line of the declaration counts calls only
            reason = self._reason(frame.f_code.co_filename, line) if line != frame.f_code.co_firstlineno else ""
            if reason:
                self._stop(frame, reason, "")
        elif event == "exception":
            if self.stop_on_errors and arg[1] is not self._error and isinstance(arg[1], Exception):
                self._error = arg[1]
                self._stop(frame, "exception", str(arg[1]))
        elif event == "return":
            self._frames -= 1
        return self._line

    def _reason(self, file: str, line: int) -> str:
        """Return why the program stops at a line; "" to go on."""
        if self._ending:
            raise SessionEnded
        if self._pausing:
            return "pause"
        if line in self.breakpoints.get(file, ()):
            return "breakpoint"
        steps = {
            Resume.STEP_IN: True,
            Resume.NEXT: self._frames <= self._depth,
            Resume.STEP_OUT: self._frames < self._depth,
        }
        return "step" if self._step is not None and steps[self._step] else ""

    def _stop(self, frame: FrameType, reason: str, text: str) -> None:
        self._pausing, self._step = False, None
        at: FrameType | None = frame
        while at is not None and len(self.frames) < MAX_FRAMES:
            if at.f_code.co_filename in self.files and is_body(at.f_code):
                self.frames.append(at)
            at = at.f_back
        self._stopped(reason, text)
        how = self._commands.get()
        self.frames.clear()
        if self._ending:
            raise SessionEnded
        self._step = how if how is not Resume.CONTINUE else None
        self._depth = self._frames


def is_body(code: CodeType) -> bool:
    """Return whether code is the body of a POU, an action or a method, and not a declaration."""
    return code.co_name == "execute" or code.co_name[:2] in ("f_", "a_", "m_")


def lines_of(code: CodeType) -> set[int]:
    """Return the lines of the bodies in `code`, at which a program can stop."""
    found = {line for _, _, line in code.co_lines() if line} if is_body(code) else set()
    if is_body(code):
        found.discard(code.co_firstlineno)
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            found |= lines_of(constant)
    return found
