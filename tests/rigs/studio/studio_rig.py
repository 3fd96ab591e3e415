"""A running Studio for tests: the real server with the shipped observatory, and a browser."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import httpx

T = TypeVar("T")
WITHIN_S = 60.0
OPERATE, VIEW = "operate-token", "view-token"


@dataclass(frozen=True)
class Studio:
    """A server. `url` is its address without a token."""

    url: str
    run_root: Path
    log: Path
    process: subprocess.Popen[bytes]

    @property
    def api(self) -> str:
        return f"{self.url}api/v1"

    @property
    def page(self) -> str:
        return f"{self.url}?token={OPERATE}"

    def client(self, token: str = OPERATE, **options: Any) -> httpx.Client:
        headers = {"Authorization": f"Bearer {token}"} if token else {}
        return httpx.Client(base_url=self.api, headers=headers, timeout=30, **options)


@contextmanager
def studio(*arguments: str, folder: Path | None = None, root: Path | None = None) -> Iterator[Studio]:
    """Start ``fieldtwin studio ARGUMENTS`` with two tokens, and stop it at the end. Run directories are in `root`/run."""
    made = root is None
    root = root or Path(tempfile.mkdtemp(prefix="fts", dir="/tmp"))
    (root / "operate").write_text(OPERATE)
    (root / "view").write_text(VIEW)
    log = root / "log"
    environment = os.environ | {"FIELDTWIN_RUN": str(root / "run")}
    command = [sys.executable, "-m", "fieldtwin", "studio", *arguments, "--no-browser"]
    command += ["--token", f"@{root / 'operate'}", "--view-token", f"@{root / 'view'}"]
    with log.open("wb") as out:
        process = subprocess.Popen(
            command, stdout=out, stderr=subprocess.STDOUT, env=environment, cwd=folder or root, start_new_session=True
        )
    try:
        line = until(lambda: _ready(log, process), "Studio serves")
        yield Studio(line.partition("  →  ")[2].partition("?")[0], root / "run", log, process)
    finally:
        process.send_signal(signal.SIGINT)
        try:
            process.wait(20)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        if made:
            shutil.rmtree(root, ignore_errors=True)


def _ready(log: Path, process: subprocess.Popen[bytes]) -> str:
    text = log.read_text(encoding="utf-8")
    if process.poll() is not None:
        raise AssertionError(f"Studio ended: {text}")
    return next((line for line in text.splitlines() if line.startswith("Studio")), "")


def until(look: Callable[[], T], what: str, within_s: float = WITHIN_S) -> T:
    """Return the first result of `look` that is true. Fail after `within_s` seconds."""
    deadline = time.monotonic() + within_s
    while True:
        found = look()
        if found:
            return found
        assert time.monotonic() < deadline, f"did not happen within {within_s:g} s: {what}"
        time.sleep(0.05)
