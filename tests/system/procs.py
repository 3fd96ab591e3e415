"""Start `fieldtwin` as a user does, and query the started processes, for the system tests."""

from __future__ import annotations

import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

CHECKOUT = Path(__file__).resolve().parents[2]


def wait_for(condition: Callable[[], Any], within_s: float = 10.0, what: str = "") -> Any:
    """Return the first true result of `condition`, evaluated every 20 ms for at most `within_s` seconds."""
    deadline = time.monotonic() + within_s
    while True:
        result = condition()
        if result:
            return result
        assert time.monotonic() < deadline, f"not within {within_s} s: {what or condition}"
        time.sleep(0.02)


def every_device_online(gateway: Asking, within_s: float = 40.0) -> None:
    """Wait until the gateway has all its devices; if it does not, report the status of each."""
    with_what: dict[str, Any] = {}

    def online() -> bool:
        with_what.update(gateway("get"))
        return all(device["online"] for device in with_what["devices"].values())

    try:
        wait_for(online, within_s, "every device online")
    except AssertionError as e:
        told = {name: with_what.get(name) for name in ("devices", "buses", "plc")}
        raise AssertionError(f"{e}: {json.dumps(told, indent=1)}") from None


def alive(pid: int) -> bool:
    """Return true while the process runs (a zombie does not)."""
    try:
        return Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def free_port() -> int:
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return int(s.getsockname()[1])


class Asking:
    """A control channel with synchronous requests: one connection per request."""

    def __init__(self, address: str | tuple[str, int]) -> None:
        self._address = address

    def __call__(self, command: str, **args: Any) -> Any:
        family = socket.AF_UNIX if isinstance(self._address, str) else socket.AF_INET
        with socket.socket(family, socket.SOCK_STREAM) as s:
            s.settimeout(10)
            s.connect(self._address)
            s.sendall(json.dumps({"v": 1, "id": 1, "command": command, "args": args}).encode() + b"\n")
            with s.makefile("rb") as lines:
                line = lines.readline()
        if not line:
            raise ConnectionResetError("the process closed its control channel without an answer")
        answer = json.loads(line)
        assert answer["ok"], answer
        return answer["result"]


class Fieldtwin:
    """One `python -m fieldtwin ...` with stdout and stderr in files. `kill` is for the end of a failed test."""

    def __init__(self, run_root: Path, *args: str, name: str = "run", env: dict[str, str] | None = None) -> None:
        run_root.mkdir(exist_ok=True)
        self.root = run_root
        self._out, self._err = run_root / f"{name}.out", run_root / f"{name}.err"
        environment = {**os.environ, "PYTHONPATH": str(CHECKOUT), "FIELDTWIN_RUN": str(run_root), **(env or {})}
        with self._out.open("wb") as out, self._err.open("wb") as err:
            self.process = subprocess.Popen(
                [sys.executable, "-W", "error::ResourceWarning", "-m", "fieldtwin", *args],
                stdin=subprocess.DEVNULL, stdout=out, stderr=err, env=environment, cwd=run_root,
            )  # fmt: skip

    @property
    def out(self) -> str:
        return self._out.read_text(encoding="utf-8")

    @property
    def err(self) -> str:
        return self._err.read_text(encoding="utf-8")

    @property
    def summary(self) -> dict[str, Any]:
        """Return the output of `--json`: the whole of stdout."""
        found: dict[str, Any] = json.loads(self.out)
        return found

    def wait(self, within_s: float = 30.0) -> int:
        return self.process.wait(within_s)

    def signal(self, number: int) -> None:
        self.process.send_signal(number)

    def control(self, instance: str, process: str) -> Asking:
        """Return the control channel of a process of an instance, once it exists."""
        path = self.root / instance / f"{process}.sock"
        wait_for(lambda: self._ready(path), 20, f"{path.name} of {instance}; {self.err}")
        return Asking(str(path))

    def _ready(self, path: Path) -> bool:
        assert self.process.poll() is None, f"ended with {self.process.returncode}: {self.err}"
        with suppress(OSError):
            return bool(Asking(str(path))("ready")["ready"])
        return False

    def pid_of(self, instance: str, process: str) -> int:
        return int(self.control(instance, process)("ready")["pid"])

    def end(self) -> None:
        """Remove all traces in every case."""
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGTERM)
            with suppress(subprocess.TimeoutExpired):
                self.process.wait(6)
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()


@contextmanager
def fieldtwin(run_root: Path, *args: str, name: str = "run", env: dict[str, str] | None = None) -> Iterator[Fieldtwin]:
    """A running `fieldtwin`, ended at the end of the block."""
    started = Fieldtwin(run_root, *args, name=name, env=env)
    try:
        yield started
    finally:
        started.end()


def run_to_end(run_root: Path, *args: str, name: str = "run", within_s: float = 30.0) -> Fieldtwin:
    """Run until it ends by itself; `.process.returncode` is the exit code."""
    with fieldtwin(run_root, *args, name=name) as started:
        started.wait(within_s)
    return started


def no_tracebacks(root: Path) -> None:
    """Require that no process wrote a traceback or a warning."""
    for path in [*root.glob("*.err"), *root.glob("*/*.log")]:
        text = path.read_text(encoding="utf-8", errors="replace")
        assert "Traceback" not in text, f"{path}:\n{text}"
        assert "Warning" not in text, f"{path}:\n{text}"
        assert "never retrieved" not in text, f"{path}:\n{text}"


# -- the remote client, by hand ----------------------------------------------------------------------------------------


def command_from_far(endpoint: str, sequence: int, period_s: int) -> None:
    """Put a period command into the remote modem's outbox (holding:100), as a third-party Modbus TCP client would."""
    match = re.fullmatch(r"tcp://([^:]+):([0-9]+)", endpoint)
    assert match, endpoint
    words = [sequence, 2, period_s & 0xFFFF]
    data = b"".join(w.to_bytes(2) for w in words)
    pdu = bytes([0x10]) + (100).to_bytes(2) + len(words).to_bytes(2) + bytes([len(data)]) + data
    with socket.create_connection((match[1], int(match[2])), timeout=5) as s:
        s.sendall(sequence.to_bytes(2) + b"\0\0" + (len(pdu) + 1).to_bytes(2) + b"\1" + pdu)
        answer = b""
        while len(answer) < 12:
            chunk = s.recv(64)
            assert chunk, f"the far modem closed after {answer!r}"
            answer += chunk
    assert answer[7] == 0x10, answer.hex()


def held_by(field: Asking, device: str, tag: str) -> list[str]:
    """Return every value of an emulated device's tag, in order, as hexadecimal register bytes."""
    return [raw for _, name, raw, _ in field("held")[device] if name == tag]
