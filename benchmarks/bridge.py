#!/usr/bin/env python3
"""The bridge from Modbus TCP to RTU on a pty that is not paced: requests a second, compared with mbusd's.

    benchmarks/bridge.py [--seconds 5] [--runs 5] [--quick]

One client in C style (a blocking socket that sends the next request when it has the reply) reads one register of a device that
answers at once. A pty has no characters, so this measures the programs and the silences that they keep between frames, and no
line. The peer mbusd is used if it is on PATH (Debian has no package of it); otherwise only our own figures are printed. mbusd
waits at least 1 ms and two characters before a request. Our bridge runs with the silence that SL 2.5.1.1 recommends above 19200
baud (1.75 ms), and with the silence of mbusd, for which the goal holds. As a bound, the table shows what the recommended silence
allows if everything else takes no time.
"""

from __future__ import annotations

import argparse
import contextlib
import multiprocessing
import os
import pty
import shutil
import socket
import subprocess
import sys
import tempfile
import time
import tty
from pathlib import Path
from statistics import median

from peers import HERE, Goals, cpu_s, free_port, python, ratio, row

from fieldtwin.gateway.core.endpoint import SerialSettings
from fieldtwin.gateway.protocols.modbus.crc import with_crc

BAUD, GOAL = 115_200, 0.9
PEER_SILENCE_US = 1000 + round(2e7 / BAUD)
RECOMMENDED, SAME = "fieldtwin bridge", f"the same, {PEER_SILENCE_US} us"
REQUEST = bytes.fromhex("0001 0000 0006 01 03 0000 0001")
RTU_REQUEST = with_crc(REQUEST[6:])
RTU_REPLY = with_crc(bytes.fromhex("01 03 02 002a"))


def device(fd: int) -> None:
    """Answer each request at once."""
    pending = b""
    while True:
        pending += os.read(fd, 256)
        while len(pending) >= len(RTU_REQUEST):
            assert pending[: len(RTU_REQUEST)] == RTU_REQUEST, pending.hex()
            pending = pending[len(RTU_REQUEST) :]
            os.write(fd, RTU_REPLY)


def per_s(port: int, seconds: float) -> float:
    """Replies a second."""
    with socket.create_connection(("127.0.0.1", port), timeout=10) as client:
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        replies, end = 0, time.perf_counter() + seconds
        begun = time.perf_counter()
        while time.perf_counter() < end:
            client.sendall(REQUEST)
            reply = b""
            while len(reply) < 11:
                reply += client.recv(64)
            assert reply[7] == 3, reply.hex()
            replies += 1
        return replies / (time.perf_counter() - begun)


def ready(port: int) -> None:
    """Wait until a request is answered."""
    deadline = time.monotonic() + 20
    while True:
        try:
            per_s(port, 0.2)
            return
        except (OSError, AssertionError):
            if time.monotonic() > deadline:
                raise
            time.sleep(0.1)


def commands(name: str, port: int, path: str) -> list[str]:
    """How a subject is started."""
    if name == "mbusd":
        # The shortest pause between requests, no retries, in the foreground: its fastest.
        return ["mbusd", "-d", "-L", "-", "-v", "0", "-p", path, "-s", str(BAUD), "-P", str(port), "-R", "1", "-N", "0"]
    target = f"rtu:{path}?baudrate={BAUD}&frame=8N1" + (f"&silence_us={PEER_SILENCE_US}" if name == SAME else "")
    return [python(), "-m", "fieldtwin", "bridge", f"tcp://127.0.0.1:{port}", target, "--instance", "bench"]


def one(name: str, path: str, seconds: float, folder: str) -> tuple[float, float]:
    """Requests a second, and CPU in microseconds a request."""
    port = free_port()
    environment = {**os.environ, "XDG_RUNTIME_DIR": folder, "PYTHONPATH": str(HERE.parent)}
    process = subprocess.Popen(
        commands(name, port, path), env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        ready(port)
        before = cpu_s(process.pid)
        rate = per_s(port, seconds)
        return rate, (cpu_s(process.pid) - before) / (rate * seconds) * 1e6
    finally:
        process.terminate()
        process.wait()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--quick", action="store_true")
    options = parser.parse_args()
    seconds, runs = (1.0, 2) if options.quick else (options.seconds, options.runs)
    names = [RECOMMENDED, SAME, *(["mbusd"] if shutil.which("mbusd") else [])]
    master, slave = pty.openpty()
    tty.setraw(slave)
    field = multiprocessing.get_context("fork").Process(target=device, args=(master,), daemon=True)
    field.start()
    rates: dict[str, list[float]] = {name: [] for name in names}
    costs: dict[str, list[float]] = {name: [] for name in names}
    try:
        with tempfile.TemporaryDirectory(prefix="ft.") as folder:
            Path(folder).chmod(0o700)
            for _ in range(runs):
                for name in names:
                    rate, cost = one(name, os.ttyname(slave), seconds, folder)
                    rates[name].append(rate)
                    costs[name].append(cost)
    finally:
        with contextlib.suppress(ProcessLookupError):
            field.terminate()
    silence_s = max(3.5 * SerialSettings(BAUD, "8N1").char_time_s, 0.00175)
    base = rates[names[-1]]
    print(f"{'':<24} {'requests/s':>12}   {'ratio':>6}   {'CPU us a request':>16}")
    for name in names:
        print(f"{row(name, rates[name], base)}   {median(costs[name]):>16.0f}")
    print(f"{'bound: the silence alone':<24} {1 / silence_s:>12.1f}")
    if "mbusd" not in names:
        print("mbusd is not installed: no comparison (Debian has no package; https://github.com/3cky/mbusd)")
        return 2
    goals = Goals()
    goals.least("requests/s at mbusd's silence, to mbusd's", ratio(rates[SAME], base), GOAL, "x")
    return goals.verdict()


if __name__ == "__main__":
    sys.exit(main())
