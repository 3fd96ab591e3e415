"""A separate mosquitto for a test, from Debian's package, on a free port."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest


def program() -> str:
    """Return mosquitto's path. Skip the test if it is missing."""
    found = shutil.which("mosquitto", path=os.environ.get("PATH", "") + ":/usr/sbin")
    if found is None:
        pytest.skip("no mosquitto here (Debian: mosquitto)")
    return found


def free_port() -> int:
    with socket.socket() as sock:
        sock.bind(("127.0.0.1", 0))
        return int(sock.getsockname()[1])


class Mosquitto:
    """A broker that a test can start and stop any number of times, on one port."""

    def __init__(self, folder: Path, *settings: str) -> None:
        self.port = free_port()
        self._program = program()
        self._config = folder / "mosquitto.conf"
        # otherwise it changes to a user that cannot read the test's folder
        user = ["user root"] if os.getuid() == 0 else []
        self._config.write_text(
            "\n".join((f"listener {self.port} 127.0.0.1", "persistence false", *user, *settings)) + "\n"
        )
        self._child: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        self._child = subprocess.Popen(
            [self._program, "-c", self._config], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        for _ in range(500):
            with suppress(OSError), socket.create_connection(("127.0.0.1", self.port), timeout=0.2):
                return
            try:
                self._child.wait(0.02)
            except subprocess.TimeoutExpired:
                continue
            break
        raise AssertionError("mosquitto did not start")

    def stop(self) -> None:
        if self._child is not None:
            self._child.kill()
            self._child.wait()
            self._child = None


@contextmanager
def broker(folder: Path, *settings: str) -> Iterator[Mosquitto]:
    """A running broker."""
    made = Mosquitto(folder, *(settings or ("allow_anonymous true",)))
    made.start()
    try:
        yield made
    finally:
        made.stop()
