"""Checks of the league: run `fieldtwin check` against the program of an entry, on loopback, ptys and software CAN buses."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from stacks import KINDS, PROGRAMS, PYTHON, Entry

READY_LIMIT_S = 20
GROUP = 8
"""Cases that one process of a device answers. A case that fails is repeated with a fresh process."""


def filled(words: Sequence[str], **places: str) -> list[str]:
    """Replace the words that stand for a line, a port or a file."""
    return [places.get(word, word) for word in words]


def fieldtwin(arguments: Sequence[str], limit_s: float) -> list[dict[str, Any]]:
    """Run a check with ``--json`` and return its cases; those of a check that took too long are missing."""
    process = subprocess.Popen(
        [PYTHON, "-m", "fieldtwin", *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        start_new_session=True,
    )  # fmt: skip
    try:
        out, err = process.communicate(timeout=limit_s)
    except subprocess.TimeoutExpired:
        return []
    finally:
        end(process)
    try:
        found = json.loads(out)
    except json.JSONDecodeError:
        print(f"  no result: {err.strip()[-400:]}", flush=True)
        return []
    return found if isinstance(found, list) else list(found["cases"])


def end(process: subprocess.Popen[str]) -> None:
    """End a process that we started, with its children."""
    try:
        os.killpg(process.pid, signal.SIGTERM)
        process.wait(5)
    except (ProcessLookupError, subprocess.TimeoutExpired):
        pass
    try:
        os.killpg(process.pid, signal.SIGKILL)
    except ProcessLookupError:
        pass
    process.wait()


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def check_client(entry: Entry, words: list[str], limit_s: float) -> list[dict[str, Any]]:
    """Run all cases on a client."""
    with tempfile.TemporaryDirectory(prefix="ftl", dir="/tmp") as folder:
        port, line = free_port(), f"{folder}/line"
        listen = {"tcp": f"tcp://127.0.0.1:{port}", "can": "can:fieldtwin/127.0.0.1:0"}.get(entry.wire, f"pty:{line}")
        words = filled(words, LINE=line, PORT=str(port))
        if entry.wire == "can":
            words = [PYTHON, str(PROGRAMS / "can_relay.py"), "-", *words]
        options = ["--ascii"] if entry.wire == "ascii" else []
        return fieldtwin(
            [*KINDS[entry.kind], "--listen", listen, "--timeout", f"{entry.timeout_s:g}s", "--probe", "output",
             "--patience", "6s", "--json", *options, "--", *words], limit_s,
        )  # fmt: skip


@contextmanager
def process_group(words: Sequence[str], ready: bool) -> Iterator[str]:
    """Start a program, and yield the first line that it prints if it prints one when it is `ready`."""
    process = subprocess.Popen(
        words, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, start_new_session=True
    )
    watch = signal.signal(signal.SIGALRM, lambda *_: os.killpg(process.pid, signal.SIGKILL))
    signal.alarm(READY_LIMIT_S)
    try:
        assert process.stdout is not None
        line = process.stdout.readline() if ready else ""
        signal.alarm(0)
        if ready and not line:
            raise RuntimeError(f"{' '.join(words)} did not start")
        yield line
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, watch)
        end(process)


def check_modbus_device(entry: Entry, words: list[str], limit_s: float, only: Sequence[str]) -> list[dict[str, Any]]:
    """Run the cases `only` on a fresh process of a Modbus device."""
    with tempfile.TemporaryDirectory(prefix="ftl", dir="/tmp") as folder:
        near, far = f"{folder}/near", f"{folder}/far"
        options = ["--unit", "1", "--timeout", "250ms", "--allow", "disrupt", "--yes", "--i-know", "--rate", "200",
                   "--write", "holding:190+10", "--write", "coil:3", "--only", ",".join(only), "--json"]  # fmt: skip
        if entry.wire == "tcp":
            with process_group(words, ready=True) as line:
                return fieldtwin([*KINDS[entry.kind], f"tcp://127.0.0.1:{line.split()[1]}", *options], limit_s)
        modem = ["socat", *(f"pty,raw,echo=0,link={path}" for path in (near, far))]
        with process_group(modem, ready=False):
            wait_for(far)
            with process_group(filled(words, LINE=far), ready=True):
                url = f"{entry.wire}:{near}?baudrate=115200&frame=8N1"
                return fieldtwin([*KINDS[entry.kind], url, *options], limit_s)


def check_node(entry: Entry, words: list[str], limit_s: float, only: Sequence[str]) -> list[dict[str, Any]]:
    """Run the cases `only` on a fresh process of a CANopen node, on its own software bus."""
    channel = f"127.0.0.1:{free_port()}"
    with tempfile.TemporaryDirectory(prefix="ftl", dir="/tmp") as folder:
        sheet = Path(folder) / "node.eds"
        words = [PYTHON, str(PROGRAMS / "can_relay.py"), channel, *filled(words, EDS=str(sheet))]
        with (
            process_group([PYTHON, "-m", "fieldtwin", "can-bus", "--listen", channel], ready=False),
            process_group(["bash", "-c", f"until echo > /dev/tcp/{channel.replace(':', '/')}; do sleep 0.1; done; exec \"$@\"",
                           "-", *words], ready=True),
        ):  # fmt: skip
            eds = ["--eds", str(sheet)] if sheet.is_file() else []
            return fieldtwin(
                [*KINDS[entry.kind], f"can:fieldtwin/{channel}", "--node", "5", *eds, "--write", "2000:00", "--write", "2004:00",
                 "--timeout", "300ms", "--boot", "2s", "--allow", "disrupt", "--yes", "--i-know", "--rate", "200",
                 "--only", ",".join(only), "--json"], limit_s,
            )  # fmt: skip


def wait_for(path: str) -> None:
    subprocess.run(["bash", "-c", f"until [ -e {path} ]; do sleep 0.05; done"], timeout=READY_LIMIT_S, check=True)


def check_device(entry: Entry, words: list[str], limit_s: float) -> list[dict[str, Any]]:
    """Run all cases on a device. Those that did not pass are repeated, each with a fresh process, and the repetition counts."""
    run = check_node if entry.wire == "can" else check_modbus_device
    listed = subprocess.run(
        [PYTHON, "-m", "fieldtwin", *KINDS[entry.kind], "--list", "--json"], capture_output=True, text=True, check=True
    )
    ids = [case["id"] for case in json.loads(listed.stdout)]
    found: dict[str, dict[str, Any]] = {}
    for at in range(0, len(ids), GROUP):
        found |= {c["id"]: c for c in run(entry, words, limit_s, ids[at : at + GROUP])}
    for id in ids:
        if id not in found or found[id]["verdict"] in ("failed", "inconclusive", "error"):
            found |= {c["id"]: c for c in run(entry, words, limit_s, [id])}
    return [found[id] for id in ids if id in found]
