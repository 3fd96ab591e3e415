#!/usr/bin/env python3
"""Importing captures: packets per second, from the file to recordings and draft profiles. Against tshark.

    benchmarks/pcap_import.py [--runs 3] [--packets 200000] [--quick]

Modbus TCP: four clients that poll four servers, ten registers per request, an acknowledgement after each reply, some requests
in two segments. RTU over TCP: the same, on a different port. CAN: frames of a SocketCAN capture. tshark, if installed, only
filters the same packets. Runs are interleaved; times are medians. The exit status is 1 if a goal is missed.
"""

from __future__ import annotations

import argparse
import shutil
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median

from peers import Goals

from fieldtwin.capture.recordings.from_packets import PacketImport
from fieldtwin.gateway.protocols.modbus.frames.crc import with_crc

PACKETS_PER_S = 50_000
SERVERS = 4


def segment(source: int, target: int, ports: tuple[int, int], sequence: int, acknowledged: int, data: bytes) -> bytes:
    """An Ethernet frame with a TCP segment; checksums are 0, as with a network card that computes them."""
    addresses = bytes((10, 0, 0, source, 10, 0, 0, target))
    ip = struct.pack(">BBHHHBBH", 0x45, 0, 40 + len(data), 0, 0x4000, 64, 6, 0) + addresses
    tcp = struct.pack(">HHIIBBHHH", *ports, sequence & 0xFFFFFFFF, acknowledged & 0xFFFFFFFF, 0x50, 0x18, 0xFFFF, 0, 0)
    return bytes(12) + b"\x08\x00" + ip + tcp + data


def make_can(path: Path, packets: int) -> int:
    """Write a capture of a CAN bus; return the number of packets."""
    with path.open("wb") as file:
        file.write(struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, 227))
        for i in range(packets):
            frame = struct.pack(">IBxxx", 0x180 + i % 100, 8) + i.to_bytes(8)
            file.write(struct.pack("<IIII", 1_700_000_000 + i // 1000, i % 1000 * 1000, len(frame), len(frame)) + frame)
    return packets


def make(path: Path, packets: int, *, rtu: bool = False) -> int:
    """Write a capture of Modbus TCP, or of RTU over TCP; return the number of packets."""
    made = 0
    sequences = [[1, 1] for _ in range(SERVERS)]
    with path.open("wb") as file:
        file.write(struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, 1))

        def put(data: bytes) -> None:
            nonlocal made
            file.write(
                struct.pack("<IIII", 1_700_000_000 + made // 1000, made % 1000 * 1000, len(data), len(data)) + data
            )
            made += 1

        number = 0
        while made < packets:
            server = number % SERVERS
            s, ports = sequences[server], (50_000 + server, 502)
            request = struct.pack(">HHHBBHH", number & 0xFFFF, 0, 6, 1, 3, number % 40 * 10, 10)
            reply = struct.pack(">HHHBBB", number & 0xFFFF, 0, 23, 1, 3, 20) + number.to_bytes(20)
            if rtu:
                request, reply, ports = with_crc(request[6:]), with_crc(reply[6:]), (50_000 + server, 4001)
            cut = 5 if number % 8 == 0 else len(request)
            for piece in (request[:cut], request[cut:]):
                if piece:
                    put(segment(1, 10 + server, ports, s[0], s[1], piece))
                    s[0] += len(piece)
            put(segment(10 + server, 1, ports[::-1], s[1], s[0], reply))
            s[1] += len(reply)
            put(segment(1, 10 + server, ports, s[0], s[1], b""))
            number += 1
    return made


def ours(capture: Path, folder: Path, run: int) -> float:
    began = time.perf_counter()
    PacketImport(capture, folder / f"run{run}.jsonl").run()
    return time.perf_counter() - began


def theirs(capture: Path) -> float:
    began = time.perf_counter()
    subprocess.run(["tshark", "-r", str(capture), "-Y", "modbus.func_code == 200"], check=True, capture_output=True)
    return time.perf_counter() - began


def main() -> int:
    parser = argparse.ArgumentParser(description="importing a capture")
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--packets", type=int, default=200_000)
    parser.add_argument("--quick", action="store_true", help="few packets, one run: does it work at all?")
    options = parser.parse_args()
    runs, wanted = (1, 20_000) if options.quick else (options.runs, options.packets)
    kinds: dict[str, Callable[[Path], int]] = {
        "Modbus TCP": lambda path: make(path, wanted),
        "RTU over TCP": lambda path: make(path, wanted, rtu=True),
        "CAN": lambda path: make_can(path, wanted),
    }
    goals = Goals()
    for kind, write in kinds.items():
        times: list[float] = []
        peer: list[float] = []
        with tempfile.TemporaryDirectory(prefix="fieldtwin-bench-") as name:
            folder = Path(name)
            packets = write(folder / "capture.pcap")
            for run in range(runs):
                times.append(ours(folder / "capture.pcap", folder, run))
                if shutil.which("tshark"):
                    peer.append(theirs(folder / "capture.pcap"))
        against = f"   tshark {packets / median(peer):.0f}" if peer else ""
        print(f"{kind:<14} {packets} packets, {runs} runs: {packets / median(times):.0f} packets/s{against}")
        goals.least(f"packets imported, {kind}", packets / median(times), PACKETS_PER_S, "a second")
    return goals.verdict()


if __name__ == "__main__":
    sys.exit(main())
