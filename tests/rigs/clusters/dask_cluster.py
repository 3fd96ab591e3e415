"""A real Dask cluster on loopback, whose workers are processes that a test can kill."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from pathlib import Path
from threading import Event

from distributed import Client

from fieldtwin.run.places.clusters import place_named
from fieldtwin.run.places.place import Place


class Cluster:
    """A scheduler with workers, all processes of this computer."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._processes: dict[str, subprocess.Popen[bytes]] = {}
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.address = f"127.0.0.1:{free.getsockname()[1]}"
        host, _, port = self.address.partition(":")
        self._start("scheduler", "scheduler", "--host", host, "--port", port, "--no-dashboard")

    def _start(self, name: str, *words: str, environment: dict[str, str] | None = None) -> None:
        with (self._folder / f"{name}.log").open("wb") as log:
            self._processes[name] = subprocess.Popen(
                [sys.executable, "-m", "dask", *words],
                cwd=self._folder,
                env=os.environ | (environment or {}),
                stdout=log,
                stderr=log,
                start_new_session=True,
            )

    def add(self, *names: str, environment: dict[str, str] | None = None) -> None:
        for name in names:
            words = ["--nthreads", "1", "--name", name, "--no-dashboard", "--no-nanny", "--memory-limit", "0"]
            words += ["--local-directory", str(self._folder)]
            self._start(name, "worker", f"tcp://{self.address}", *words, environment=environment)

    def kill(self, name: str) -> None:
        self._processes[name].kill()

    def pid(self, name: str) -> int:
        return self._processes[name].pid

    def place(self) -> Place:
        return place_named(f"dask://{self.address}", None)

    def close(self) -> None:
        for process in self._processes.values():
            process.kill()
        for process in self._processes.values():
            process.wait()


def start_dask_threads() -> None:
    """Start the threads that Dask keeps until this process ends, so that no test appears to have left them."""
    called = Event()
    with Client(processes=False, n_workers=1, dashboard_address="127.0.0.1:0", set_as_default=False) as client:
        client.submit(int).add_done_callback(lambda future: called.set())
        assert called.wait(30)
