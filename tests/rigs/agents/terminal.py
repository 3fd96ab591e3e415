"""A user at a terminal: `fieldtwin` with a pseudo-terminal as its stdin, stdout and stderr."""

from __future__ import annotations

import os
import select
import subprocess
import sys
import time
from pathlib import Path

from procs import CHECKOUT


class Terminal:
    """A command in a terminal. `text` is all that it has printed so far."""

    def __init__(self, root: Path, *arguments: str) -> None:
        self.text = ""
        self._near, far = os.openpty()
        environment = {**os.environ, "PYTHONPATH": str(CHECKOUT), "FIELDTWIN_RUN": str(root), "TERM": "dumb"}
        command = [sys.executable, "-m", "fieldtwin", *arguments]
        self._process = subprocess.Popen(
            command, stdin=far, stdout=far, stderr=far, env=environment, cwd=root, start_new_session=True
        )
        os.close(far)

    def until(self, text: str, within_s: float = 60.0) -> None:
        """Wait until the command has printed a text."""
        end_s = time.monotonic() + within_s
        while text not in self.text:
            assert self._read(end_s), f"{text!r} is not in {self.text!r}"

    def answer(self, text: str) -> None:
        """Type a line."""
        os.write(self._near, text.encode() + b"\n")

    def end(self, within_s: float = 60.0) -> int:
        """Wait for the end, and return the exit code."""
        end_s = time.monotonic() + within_s
        while self._read(end_s):
            pass
        code = self._process.wait(within_s)
        os.close(self._near)
        return code

    def _read(self, end_s: float) -> bool:
        """Read what has arrived, and return false at the end of the output."""
        ready, _, _ = select.select([self._near], [], [], max(0.0, end_s - time.monotonic()))
        try:
            data = os.read(self._near, 4096) if ready else b""
        except OSError:  # Linux reports EIO when the command has ended
            data = b""
        self.text += data.decode(errors="replace").replace("\r\n", "\n")
        return bool(data)
