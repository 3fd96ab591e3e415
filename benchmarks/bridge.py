#!/usr/bin/env python3
"""The bridge from Modbus TCP to RTU on a pty that is not paced: requests per second, compared with a bridge in C and with mbusd.

    benchmarks/bridge.py [--seconds 5] [--runs 5] [--quick]

One client in C style (a blocking socket that sends the next request when it has the reply) reads one register of a device that
answers at once. A pty has no character times, so this measures the programs and the silences that they keep between frames, not
a line. The silence before a request determines most of a rate, so programs are compared at the same silence:

- at 1.75 ms, which SL 2.5.1.1 recommends above 19200 baud and which our bridge keeps by default;
- at the silence of `mbusd -R 1`, 1 ms and two characters.

The bridge in C (c/modbus_bridge.c) does only what every bridge has to do. mbusd is compared too if it is on PATH (Debian has no
package of it). `over the silence` is the time of a request that is not silence: the device, the pty, and the program.
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

from peers import HERE, Goals, Missing, build, cpu_s, free_port, python, ratio

from fieldtwin.gateway.core.endpoint import SerialSettings
from fieldtwin.gateway.protocols.modbus.frames.crc import with_crc

BAUD, GOAL = 115_200, 0.9
PEER_SILENCE_US = 1000 + round(2e7 / BAUD)
RECOMMENDED_US = round(max(3.5 * SerialSettings(BAUD, "8N1").char_time_s, 0.00175) * 1e6)
OURS, IN_C, MBUSD = "fieldtwin bridge", "bridge in C", "mbusd"
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
    """Return replies per second."""
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


def commands(name: str, silence_us: int, in_c: Path, port: int, path: str) -> list[str]:
    """Return the command that starts a subject."""
    if name == MBUSD:
        # The shortest pause between requests, no retries, in the foreground: its fastest settings.
        return ["mbusd", "-d", "-L", "-", "-v", "0", "-p", path, "-s", str(BAUD), "-P", str(port), "-R", "1", "-N", "0"]
    if name == IN_C:
        return [str(in_c), str(port), path, str(silence_us)]
    silence = "" if silence_us == RECOMMENDED_US else f"&silence_us={silence_us}"
    target = f"rtu:{path}?baudrate={BAUD}&frame=8N1{silence}"
    return [python(), "-m", "fieldtwin", "bridge", f"tcp://127.0.0.1:{port}", target, "--instance", "bench"]


def one(command: list[str], port: int, seconds: float, folder: str) -> tuple[float, float]:
    """Return requests per second, and CPU time in microseconds per request."""
    environment = {**os.environ, "XDG_RUNTIME_DIR": folder, "PYTHONPATH": str(HERE.parent)}
    process = subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
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
    try:
        in_c = build("modbus_bridge")
    except Missing as e:
        print(f"not installed: {e}")
        return 2
    subjects = [(name, us) for us in (RECOMMENDED_US, PEER_SILENCE_US) for name in (OURS, IN_C)]
    if shutil.which(MBUSD):
        subjects.append((MBUSD, PEER_SILENCE_US))
    master, slave = pty.openpty()
    tty.setraw(slave)
    field = multiprocessing.get_context("fork").Process(target=device, args=(master,), daemon=True)
    field.start()
    rates: dict[tuple[str, int], list[float]] = {subject: [] for subject in subjects}
    costs: dict[tuple[str, int], list[float]] = {subject: [] for subject in subjects}
    try:
        with tempfile.TemporaryDirectory(prefix="ft.") as folder:
            Path(folder).chmod(0o700)
            for _ in range(runs):
                for subject in subjects:
                    port = free_port()
                    rate, cost = one(commands(*subject, in_c, port, os.ttyname(slave)), port, seconds, folder)
                    rates[subject].append(rate)
                    costs[subject].append(cost)
    finally:
        with contextlib.suppress(ProcessLookupError):
            field.terminate()
    print(f"{'':<18} {'silence us':>10}   {'requests/s':>10}   {'over the silence us':>19}   {'CPU us a request':>16}")
    for (name, us), values in rates.items():
        rate = median(values)
        print(f"{name:<18} {us:>10}   {rate:>10.1f}   {1e6 / rate - us:>19.0f}   {median(costs[name, us]):>16.0f}")
    print(
        f"the recommended silence alone allows {1e6 / RECOMMENDED_US:.0f} requests/s, mbusd's {1e6 / PEER_SILENCE_US:.0f}"
    )
    goals = Goals()
    for us in (RECOMMENDED_US, PEER_SILENCE_US):
        goals.least(f"to the bridge in C, silence {us} us", ratio(rates[OURS, us], rates[IN_C, us]), GOAL, "x")
    if (MBUSD, PEER_SILENCE_US) in rates:
        theirs = rates[MBUSD, PEER_SILENCE_US]
        goals.least("to mbusd, at its silence", ratio(rates[OURS, PEER_SILENCE_US], theirs), GOAL, "x")
    return goals.verdict()


if __name__ == "__main__":
    sys.exit(main())
