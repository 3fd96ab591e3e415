"""Start the worker process, which runs emulated devices and programs for tests, and communicate with it.

There is one worker process per test session; it is started on first use. This module imports only the standard library, and no
other part of fieldtwin, because it is imported into the user's own test run.
"""

from __future__ import annotations

import json
import os
import shlex
import subprocess
import sys
import tempfile
import threading
from collections import deque
from collections.abc import Sequence
from queue import Empty, Queue
from typing import IO, Any

ANSWER_WITHIN_S = 60.0
END_WITHIN_S = 5.0
COMMAND_VARIABLE = "FIELDTWIN_COMMAND"


class FieldtwinUnavailable(Exception):
    """Raised when the process could not be started, or ended; contains its output."""


class FieldtwinRefused(Exception):
    """Raised for a request that makes no sense or could not be fulfilled; `kind` is the error's class in the other process."""

    def __init__(self, message: str, kind: str = "") -> None:
        super().__init__(message)
        self.kind = kind


def command_of(said: str = "") -> list[str]:
    """Return the command that runs fieldtwin: `said`, else FIELDTWIN_COMMAND, else this Python with ``-m fieldtwin``."""
    text = said or os.environ.get(COMMAND_VARIABLE, "")
    return shlex.split(text) if text else [sys.executable, "-P", "-m", "fieldtwin"]


class WorkerProcess:
    """The worker process ``COMMAND test-host``. The first `call` starts it. Any thread may call; calls are executed in turn."""

    def __init__(self, command: Sequence[str] = (), *, trust: bool = False) -> None:
        self.command = list(command) or command_of()
        self.trust = trust
        """Whether the code of templates from other sources may run without asking the user."""
        self._process: subprocess.Popen[str] | None = None
        self._answers: Queue[str | None] = Queue()
        self._said: IO[str] | None = None
        self._lock = threading.Lock()
        self._number = 0

    def call(self, command: str, **args: Any) -> Any:
        """Execute the command `command` and return its result. Raises `FieldtwinRefused` or `FieldtwinUnavailable`."""
        __tracebackhide__ = True
        with self._lock:
            process = self._started()
            self._number += 1
            request = {"v": 1, "id": self._number, "command": command, "args": args}
            assert process.stdin is not None
            try:
                process.stdin.write(json.dumps(request) + "\n")
                process.stdin.flush()
            except OSError:
                raise self._gone() from None
            answer = self._answer(self._number, command)
        if answer.get("ok"):
            return answer.get("result")
        error = answer.get("error") or {}
        raise FieldtwinRefused(str(error.get("message", "?")), str(error.get("kind", "")))

    def _answer(self, number: int, command: str) -> dict[str, Any]:
        while True:
            try:
                line = self._answers.get(timeout=ANSWER_WITHIN_S)
            except Empty:
                raise FieldtwinUnavailable(f"no answer to {command!r} within {ANSWER_WITHIN_S:g} s") from None
            if line is None:
                raise self._gone()
            try:
                answer = json.loads(line)
            except ValueError:
                raise FieldtwinUnavailable(f"{shlex.join(self.command)} said {line.strip()[:200]!r}") from None
            if isinstance(answer, dict) and answer.get("id") == number:
                return answer

    def _started(self) -> subprocess.Popen[str]:
        if self._process is not None:
            return self._process
        self._said = tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace")  # noqa: SIM115 - closed with the process
        try:
            process = subprocess.Popen(
                [*self.command, "test-host", *(["--trust"] if self.trust else [])],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=self._said,
                text=True,
                encoding="utf-8",
                start_new_session=True,  # Ctrl-C must reach only pytest: the worker process ends when its input ends
            )
        except OSError as e:
            self._said.close()
            raise FieldtwinUnavailable(
                f"cannot start {self.command[0]!r}: {e.strerror or e}; --fieldtwin-command or {COMMAND_VARIABLE} sets the command"
            ) from e
        threading.Thread(target=_pump, args=(process, self._answers), daemon=True, name="fieldtwin").start()
        self._process = process
        return process

    def _gone(self) -> FieldtwinUnavailable:
        """Return the error for a process that has ended, with its exit status and its last output."""
        assert self._process is not None
        assert self._said is not None
        try:
            code: int | None = self._process.wait(END_WITHIN_S)
        except subprocess.TimeoutExpired:
            code = None
        self._said.seek(0)
        last = "".join(deque(self._said, maxlen=5)).strip()
        ended = "no longer answers" if code is None else f"ended with status {code}"
        hint = ""
        if "No module named" in last:  # only the plugin is installed in this environment
            last, hint = last.splitlines()[-1], f"; --fieldtwin-command or {COMMAND_VARIABLE} sets the command"
        return FieldtwinUnavailable(
            f"{shlex.join(self.command)} test-host {ended}: {last or 'it printed nothing'}{hint}"
        )

    def close(self) -> None:
        """End the process, with all devices and programs that it runs."""
        process, self._process = self._process, None
        if process is None:
            return
        assert process.stdin is not None
        try:
            process.stdin.close()
        except OSError:
            pass  # the process had already ended
        try:
            process.wait(END_WITHIN_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        if process.stdout is not None:
            process.stdout.close()
        if self._said is not None:
            self._said.close()


def _pump(process: subprocess.Popen[str], answers: Queue[str | None]) -> None:
    """Put every line of the process's output into `answers`, and None at its end."""
    assert process.stdout is not None
    try:
        for line in process.stdout:
            answers.put(line)
    except (OSError, ValueError):
        pass  # another thread closed the pipe, so no further answer can arrive
    answers.put(None)
