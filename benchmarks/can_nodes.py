#!/usr/bin/env python3
"""127 emulated CANopen nodes on one modelled bus of 1 Mbit/s, each with a heartbeat of 1 s and a TPDO of 100 ms.

    benchmarks/can_nodes.py [--runs 3] [--seconds 5] [--nodes 127]

Do they keep up? How late is a TPDO relative to its timer, is one lost, and how much CPU time does the process use? The peer is
the `canopen` package: the same number of LocalNodes with periodic TPDOs and heartbeats on python-can's virtual bus, which does
not model timing. Each run is a separate process, both alternate; the results are medians and ratios of pairs. The exit status
is 1 if a goal is missed. Needs an idle machine.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import subprocess
import sys
import time
from pathlib import Path
from statistics import median

from peers import Goals, python, ratio

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

PERIOD_S, HEARTBEAT_S, BITRATE = 0.1, 1.0, 1_000_000
WARM_UP_S = 1.0
OURS, PEER = "fieldtwin", "canopen LocalNode"


def late(times_s: dict[int, list[float]]) -> list[float]:
    """Return the lateness of each TPDO relative to its node's grid, in ms; the grid starts at the node's most punctual TPDO."""
    out: list[float] = []
    for times in times_s.values():
        offsets = [t - n * PERIOD_S for n, t in enumerate(times)]
        out += [(offset - min(offsets)) * 1000 for offset in offsets]
    return sorted(out)


def report(times_s: dict[int, list[float]], nodes: int, seconds: float, cpu_s: float, load: float) -> None:
    """Return one line of JSON: the result of one side's run."""
    lateness = late(times_s)
    whole = round(seconds / PERIOD_S)
    fewest = min((len(times) for times in times_s.values()), default=0) if len(times_s) == nodes else 0
    print(
        json.dumps(
            {
                "missing": max(0, whole - 1 - fewest),  # one may fall on either side of the window's edges
                "tpdos": sum(len(t) for t in times_s.values()),
                "p50_ms": lateness[len(lateness) // 2],
                "p99_ms": lateness[len(lateness) * 99 // 100],
                "max_ms": lateness[-1],
                "cpu": cpu_s / seconds,
                "load": load,
            }
        )
    )


async def ours(nodes: int, seconds: float) -> None:
    """Run every node with its recording and model on the paced bus; a watcher counts the frames on it."""
    from fieldtwin.emulators.canopen.serve import serve_node
    from fieldtwin.emulators.endpoints.can.bus_runner import BusRunner
    from fieldtwin.emulators.models.canopen.emulated_node import emulated_node
    from fieldtwin.emulators.signals import SignalPlayer, SignalTrack
    from fieldtwin.gateway.core.canframe import CanFrame
    from fieldtwin.gateway.core.endpoint import Endpoint
    from fieldtwin.gateway.core.files.profile_file import load_profile
    from fieldtwin.gateway.wallclock import WallClock

    clock, here = WallClock(), Endpoint.parse("can:fieldtwin/127.0.0.1:1")
    bus = BusRunner(BITRATE, max_nodes=nodes + 1)
    profile = load_profile(ROOT / "profiles" / "devices" / "inclinometer-cia410.yaml")
    track = SignalTrack.load(ROOT / "recordings" / "incl.jsonl")
    master = bus.attach(here, "master")
    made, tasks = [], []
    for node_id in range(1, nodes + 1):
        player = SignalPlayer(track, clock.monotonic_ns())
        node = emulated_node(profile, node_id, player, clock.monotonic_ns()).node
        node.data.put_number(0x1017, 0, round(HEARTBEAT_S * 1000))
        made.append(node)
        tasks.append(asyncio.create_task(serve_node(bus.attach(here), node, clock)))
    await asyncio.sleep(0.2)
    for node_id in range(1, nodes + 1):  # by SDO and one after the other, so that the timers are not synchronised
        event = b"\x2b\x00\x18\x05" + round(PERIOD_S * 1000).to_bytes(4, "little")
        await master.send(CanFrame(0x600 + node_id, event))
        await master.send(
            CanFrame(0x600 + node_id, b"\x2b\x17\x10\x00" + round(HEARTBEAT_S * 1000).to_bytes(4, "little"))
        )
        await master.send(CanFrame(0, bytes([1, node_id])))
        await asyncio.sleep(PERIOD_S / nodes)
    await asyncio.sleep(WARM_UP_S)
    seen: dict[int, int] = {}
    before, cpu = bus.stats(), time.process_time()
    start_ns = clock.monotonic_ns()
    deadline = start_ns + round(seconds * 1e9)
    master.accept = None
    while clock.monotonic_ns() < deadline:
        frame = await master.recv()
        if 0x180 < frame.can_id <= 0x1FF and frame.t_ns >= start_ns:
            seen[frame.can_id] = seen.get(frame.can_id, 0) + 1
    cpu = time.process_time() - cpu
    end_ns = clock.monotonic_ns()
    sent = {
        node.node_id: [p.t_ns / 1e9 for p in node.journal if start_ns <= p.t_ns < end_ns and 0x180 < p.cob_id <= 0x1FF]
        for node in made
    }
    lost = sum(len(times) for times in sent.values()) - sum(seen.values())
    assert master.overruns == 0, master.overruns
    assert abs(lost) <= 2 * nodes * 0.02 + 2, lost  # in transit at the window's edges
    bits = bus.stats()["bits"] - before["bits"]
    report(sent, nodes, seconds, cpu, bits / BITRATE / seconds)
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)


def peer(nodes: int, seconds: float) -> None:
    """Run LocalNodes with periodic TPDOs; an additional bus records the times of arrival."""
    import can
    import canopen

    eds = str(ROOT / "profiles" / "devices" / "inclinometer-cia410.eds")
    network = canopen.Network()
    network.connect(interface="virtual", channel="bench")
    watch = can.Bus(interface="virtual", channel="bench")
    made = [network.add_node(canopen.LocalNode(node_id, eds)) for node_id in range(1, nodes + 1)]
    for node in made:
        node.tpdo.read()
        node.tpdo[1].start(PERIOD_S)
        node.nmt.start_heartbeat(round(HEARTBEAT_S * 1000))
        time.sleep(PERIOD_S / nodes)
    time.sleep(WARM_UP_S)
    while watch.recv(timeout=0) is not None:
        pass
    times: dict[int, list[float]] = {}
    cpu, end = time.process_time(), time.monotonic() + seconds
    while time.monotonic() < end:
        message = watch.recv(timeout=0.05)
        if message is not None and 0x180 < message.arbitration_id <= 0x1FF:
            times.setdefault(message.arbitration_id, []).append(message.timestamp)
    report(times, nodes, seconds, time.process_time() - cpu, 0.0)
    sys.stdout.flush()
    for node in made:
        node.tpdo[1].stop()
        node.nmt.stop_heartbeat()
    watch.shutdown()
    network.disconnect()


def run_side(side: str, nodes: int, seconds: float) -> dict[str, float]:
    command = [
        python(),
        str(Path(__file__).resolve()),
        "--side",
        side,
        "--nodes",
        str(nodes),
        "--seconds",
        str(seconds),
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{side}: {done.stderr.strip()}")
    return dict(json.loads(done.stdout))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--nodes", type=int, default=127)
    parser.add_argument("--side", choices=(OURS, PEER), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.side == OURS:
        asyncio.run(ours(options.nodes, options.seconds))
        return 0
    if options.side == PEER:
        peer(options.nodes, options.seconds)
        return 0
    found: dict[str, list[dict[str, float]]] = {OURS: [], PEER: []}
    for _ in range(options.runs):
        for side, runs in found.items():
            runs.append(run_side(side, options.nodes, options.seconds))
    print(
        f"{options.nodes} nodes, TPDO {PERIOD_S * 1000:.0f} ms, heartbeat {HEARTBEAT_S:.0f} s; {options.runs} runs, medians\n"
    )
    print(f"{'':<20}{'TPDOs/s':>9}{'missing':>9}{'late p50':>10}{'p99':>9}{'max, ms':>9}{'CPU':>7}{'bus load':>10}")
    for side, runs in found.items():
        of = {key: median(run[key] for run in runs) for key in runs[0]}
        load = f"{of['load']:>9.0%}" if side == OURS else f"{'-':>9}"
        print(
            f"{side:<20}{of['tpdos'] / options.seconds:>9.0f}{of['missing']:>9.0f}{of['p50_ms']:>10.2f}"
            f"{of['p99_ms']:>9.2f}{of['max_ms']:>9.2f}{of['cpu']:>7.0%} {load}"
        )
    for what in ("cpu", "p99_ms"):
        print(f"{what} against {PEER}: {ratio([r[what] for r in found[OURS]], [r[what] for r in found[PEER]]):.2f}")
    goals, mine = Goals(), found[OURS]
    goals.most("TPDOs missing, worst node", max(r["missing"] for r in mine), 0)
    goals.most("lateness p99", median(r["p99_ms"] for r in mine), PERIOD_S * 1000 / 10, "ms")
    goals.most("lateness max", median(r["max_ms"] for r in mine), PERIOD_S * 1000, "ms")
    goals.most("CPU of one core", median(r["cpu"] for r in mine), 0.8)
    return goals.verdict()


if __name__ == "__main__":
    sys.exit(main())
