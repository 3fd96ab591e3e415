"""Stop a long command and keep its results: `q` on a terminal, or Ctrl-C once; a second Ctrl-C ends it at once."""

from __future__ import annotations

import asyncio
import contextlib
import signal
import sys
from collections.abc import Iterator
from types import FrameType


class StopKey:
    """The request of the user to stop. Use it as ``with StopKey() as stop:`` inside a running loop; `pressed` becomes true on
    `q` or Ctrl-C."""

    def __init__(self) -> None:
        self._pressed = False
        self._undo = contextlib.ExitStack()

    @property
    def listens(self) -> bool:
        """Return whether the program can read keys from a terminal, so that the user can press `q`."""
        return sys.stdin is not None and sys.stdin.isatty()

    def pressed(self) -> bool:
        return self._pressed

    def __enter__(self) -> StopKey:
        self._undo.enter_context(self._interrupts())
        if self.listens:
            self._undo.enter_context(self._keys())
        return self

    def __exit__(self, *_: object) -> None:
        self._undo.close()

    @contextlib.contextmanager
    def _interrupts(self) -> Iterator[None]:
        before = signal.getsignal(signal.SIGINT)

        def interrupted(number: int, frame: FrameType | None) -> None:
            if self._pressed:
                raise KeyboardInterrupt
            self._pressed = True

        try:
            signal.signal(signal.SIGINT, interrupted)
        except ValueError:  # this code does not run in the main thread, which receives Ctrl-C
            yield
            return
        try:
            yield
        finally:
            signal.signal(signal.SIGINT, before)

    @contextlib.contextmanager
    def _keys(self) -> Iterator[None]:
        """Read single keys without Enter if the terminal supports it; else only Ctrl-C works."""
        try:
            import termios
            import tty
        except ImportError:  # Windows has no terminal attributes
            yield
            return
        descriptor = sys.stdin.fileno()
        try:
            before = termios.tcgetattr(descriptor)
        except termios.error:
            yield
            return
        loop = asyncio.get_running_loop()
        tty.setcbreak(descriptor)
        loop.add_reader(descriptor, self._on_key)
        try:
            yield
        finally:
            loop.remove_reader(descriptor)
            termios.tcsetattr(descriptor, termios.TCSADRAIN, before)

    def _on_key(self) -> None:
        if sys.stdin.read(1) in ("q", "Q", ""):
            self._pressed = True
