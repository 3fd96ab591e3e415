"""One process that is killed repeatedly at seeded random instants, and the traces that it must not leave."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from procs import CHECKOUT, alive, wait_for

KILLS = int(os.environ.get("FIELDTWIN_KILLS", "100"))
"""Number of kills per process."""
KILLS_OF_A_RUN = int(os.environ.get("FIELDTWIN_KILLS_OF_A_RUN", "12"))
"""A whole run takes seconds to start, so 100 of them take ten minutes; that number is only used manually."""
SEED = int(os.environ.get("FIELDTWIN_KILLS_SEED", "0"))
"""Another seed gives other instants."""


class Victim:
    """A process of fieldtwin that can be started again at once. `rng` is the seeded random generator of the test."""

    def __init__(self, module: str, *args: str, root: Path, imports: str = "", seed: int = 1) -> None:
        self.rng = random.Random(seed + 1000 * SEED)
        self.log = root / f"{module}.kills.err"
        self.log.touch()
        self.pid = 0
        self.starts = 0
        ready = root / f"{module}.imported"
        environment = {
            **os.environ, "PYTHONPATH": str(CHECKOUT), "FIELDTWIN_RUN": str(root),
            "MANY_KILLS_IMPORT": imports, "MANY_KILLS_READY": str(ready),
        }  # fmt: skip
        self._process = subprocess.Popen(
            [sys.executable, str(Path(__file__).with_name("many_kills.py")), module, *args],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment, cwd=root, text=True, bufsize=1,
        )  # fmt: skip
        wait_for(ready.exists, 30, "the modules are imported")

    def start(self) -> int:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        print(self.log, file=self._process.stdin, flush=True)
        self.pid = int(self._process.stdout.readline())
        self.starts += 1
        return self.pid

    def at_some_instant(self, most_s: float) -> None:
        """Wait for a random time, because the test is about the instant of the kill."""
        time.sleep(self.rng.uniform(0, most_s))

    def end(self, number: int = signal.SIGKILL) -> None:
        """Send the signal, and wait until the process has ended."""
        assert self._process.stdout is not None
        with suppress(ProcessLookupError):
            os.kill(self.pid, number)
        assert self._process.stdout.readline() == "ended\n"
        assert not alive(self.pid)

    def close(self) -> None:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        if self.pid and alive(self.pid):
            os.kill(self.pid, signal.SIGKILL)
        self._process.stdin.close()
        self._process.wait(20)
        self._process.stdout.close()


@contextmanager
def victim(module: str, *args: str, root: Path, imports: str = "", seed: int = 1) -> Iterator[Victim]:
    root.mkdir(exist_ok=True)
    made = Victim(module, *args, root=root, imports=imports, seed=seed)
    try:
        yield made
    finally:
        made.close()


def processes_of(root: Path) -> dict[int, str]:
    """Return the processes with the test's folder in their command line or as their directory, descendants or not."""
    found = {}
    for folder in Path("/proc").iterdir():
        if not folder.name.isdigit() or int(folder.name) == os.getpid():
            continue
        with suppress(OSError):
            words = (folder / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
            if alive(int(folder.name)) and (str(root) in words or str(root) in os.readlink(folder / "cwd")):
                found[int(folder.name)] = words
    return found


def nothing_is_left(root: Path, within_s: float = 10) -> None:
    """Require that no process, no socket of one, and no link to a pseudo-terminal remains: the kernel removes that with its
    last process."""
    wait_for(lambda: not processes_of(root), within_s, f"processes are left: {processes_of(root)}")
    assert [path for path in root.rglob("*") if path.is_socket() or path.is_symlink()] == []
