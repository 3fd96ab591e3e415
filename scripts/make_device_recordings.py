#!/usr/bin/env python3
"""Generate recordings of the devices with profiles in fieldtwin: plausible values from the facts in the manuals, with a seed.

    scripts/make_device_recordings.py [--seed N] [--out DIR]

Nothing here was measured: every header contains `synthetic`. The same seed gives the same bytes; a test compares them.
"""

from __future__ import annotations

import argparse
import math
import random
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
if str(ROOT) not in sys.path:  # run as a file, the checkout's packages are not on the path
    sys.path.insert(0, str(ROOT))

from fieldtwin.emulators.codec import encode  # noqa: E402
from fieldtwin.gateway.core.files.profile import READ_FUNCTION, DeviceProfile  # noqa: E402
from fieldtwin.gateway.core.files.profile_file import load_profile  # noqa: E402
from fieldtwin.gateway.core.files.recording import RecordedExchange, RecordingHeader, RecordingWriter, SignalInfo  # noqa: E402

DEFAULT_SEED = 1
ROUNDS = 20
EVERY_S = 5.0

Value = float | int | str
Steps = Callable[[random.Random, int], Mapping[str, Value]]
"""Map (random, round) to the value of each tag, as the raw number of its type."""


def sdm630(r: random.Random, n: int) -> Mapping[str, Value]:
    """A small workshop on three phases; energy counts up."""
    volts = [230.0 + r.gauss(0, 0.6) for _ in range(3)]
    amps = [3.0 + r.random(), 2.0 + r.random(), 4.0 + r.random()]
    out: dict[str, Value] = {}
    for i, (u, a) in enumerate(zip(volts, amps, strict=True), 1):
        out |= {f"voltage_l{i}": u, f"current_l{i}": a, f"power_l{i}": u * a * 0.95, f"apparent_l{i}": u * a}
        out |= {f"reactive_l{i}": u * a * 0.31, f"power_factor_l{i}": 0.95}
    total = sum(u * a * 0.95 for u, a in zip(volts, amps, strict=True))
    out |= {"power": total, "frequency": 50.0 + r.gauss(0, 0.01), "energy_in": 1234.5 + 0.003 * n, "energy_out": 0.0}
    return out | {"demand_period": 60.0, "system_type": 3.0, "parity_stop": 0.0, "unit_id": 1.0}


def c4e(r: random.Random, n: int) -> Mapping[str, Value]:
    """River water."""
    return {
        "temperature": 14.2 + r.gauss(0, 0.02),
        "conductivity": 412.0 + r.gauss(0, 0.5),
        "salinity": 0.2,
        "tds": 206.0,
    }


def vfd_e(r: random.Random, n: int) -> Mapping[str, Value]:
    """A drive that runs at 35 Hz."""
    return {
        "command": 2, "frequency_set": 3500, "fault": 0, "status": 0x0003, "running": 0x0003, "frequency_wanted": 3500,
        "frequency": 3500 + r.randint(-2, 2), "current": 21 + r.randint(-1, 1), "dc_voltage": 3105,
        "output_voltage": 1610, "temperature": 41,
    }  # fmt: skip


def rover(r: random.Random, n: int) -> Mapping[str, Value]:
    """Noon: the battery is charging."""
    return {
        "model": "RNG-CTRL-RVR40", "unit_id": 1, "soc": 87, "battery_voltage": 134 + r.randint(0, 1),
        "charging_current": 842 + r.randint(-9, 9), "controller_temperature": 27 << 8 | 24,
        "controller_below_zero": 27 << 8 | 24, "load_voltage": 133, "load_current": 110, "load_power": 14,
        "panel_voltage": 187, "panel_current": 605, "charging_power": 113, "days": 412, "charged": 15_230 + n // 10,
        "generated": 1_204_500 + n, "charging_state": 2, "fault": 0,
    }  # fmt: skip


def sunspec(r: random.Random, n: int) -> Mapping[str, Value]:
    """A 10 kW inverter at half its power. The current of the third phase and many other values are not implemented."""
    details = {
        f"{name}_{i}": 0x8000 - 0x10000
        for name, n in (("power_details", 6), ("temperature", 4))
        for i in range(1, n + 1)
    }
    details |= {f"dc_details_{i}": 0xFFFF if i in (1, 3) else 0x8000 for i in range(1, 7)}
    details |= {"event_1": 0, **{f"event_{i}": 0xFFFFFFFF for i in range(2, 7)}}
    return {
        "sunspec": "SunS", "common_header": 1 << 16 | 66, "options": "", "version": "1.0", "device_address": 126,
        "pad": 0x8000, "inverter_header": 103 << 16 | 50, "voltage_ll1": 3985, "voltage_ll2": 3981, "voltage_ll3": 3990,
        "tmp_sf": 0x8000 - 0x10000, "vendor_state": 0xFFFF, "end_header": 0xFFFF0000, **details,
        "manufacturer": "fieldtwin", "model": "synthetic 10k", "serial": "S-0001", "current": 2174, "current_l1": 725,
        "current_l2": 724, "current_l3": 0xFFFF, "a_sf": -2, "voltage_l1": 2301 + r.randint(-5, 5),
        "voltage_l2": 2298 + r.randint(-5, 5), "voltage_l3": 2305, "v_sf": -1, "power": 500 + r.randint(-3, 3), "w_sf": 1,
        "frequency": 5001, "hz_sf": -2, "energy": 1_500_000 + n, "wh_sf": 1, "state": 4,
    }  # fmt: skip


DEVICES: dict[str, Steps] = {
    "eastron-sdm630": sdm630,
    "aqualabo-c4e": c4e,
    "delta-vfd-e": vfd_e,
    "renogy-rover": rover,
    "sunspec-inverter-103": sunspec,
}


LOOP_S = 60
"""Duration of a CANopen node's signals until they repeat; the last row equals the first."""

Rows = Iterator[tuple[float, Sequence[float]]]


def io_module(r: random.Random) -> Rows:
    """A pump station: float switches, a running light, a level that rises and falls. Inputs change in steps."""
    phase = [r.random() * 2 * math.pi for _ in range(4)]
    last: tuple[int, int] | None = None
    for i in range(LOOP_S * 5 + 1):
        t = i / 5
        turn = 2 * math.pi * (t % LOOP_S) / LOOP_S
        level = 5.0 - 3.0 * math.cos(turn)
        switches = sum(1 << n for n, at in enumerate((2.5, 4.0, 5.5, 7.0)) if level > at)
        inputs = switches, 1 << (int(t % LOOP_S) % 8)
        volts = [level, *(2.5 + 0.5 * n + 0.4 * math.sin((n + 1) * turn + phase[n]) for n in (1, 2, 3))]
        analogue = [round(v, 4) for v in volts]
        if last is not None and last != inputs:
            yield t, (*last, *analogue)
        last = inputs
        yield t, (*inputs, *analogue)


def drive(r: random.Random) -> Rows:
    """Values that a drive cannot compute from its set-points: the mains' ripple on its DC link, and the load on its shaft."""
    phase = r.random() * 2 * math.pi
    for i in range(LOOP_S * 10 + 1):
        turn = 2 * math.pi * (i % (LOOP_S * 10)) / (LOOP_S * 10)
        yield i / 10, (round(14.0 + 6.0 * math.sin(3 * turn + phase), 1), round(325.0 + 2.0 * math.sin(12 * turn), 3))


def measuring_device(r: random.Random) -> Rows:
    """A working hydraulic cylinder: 80 to 210 bar, oil that warms and cools."""
    phase = r.random() * 2 * math.pi
    for i in range(LOOP_S * 10 + 1):
        turn = 2 * math.pi * (i % (LOOP_S * 10)) / (LOOP_S * 10)
        bar = 145.0 + 50.0 * math.sin(4 * turn + phase) + 15.0 * math.sin(11 * turn)
        yield i / 10, (round(bar, 3), round(41.0 + 3.0 * math.sin(turn), 3))


def encoder(r: random.Random) -> Rows:
    """A winch: forty turns out and forty turns back, in a minute, starting at turn 1000."""
    start = 1000 * 8192 + r.randrange(8192)
    for i in range(LOOP_S * 10 + 1):
        turn = 2 * math.pi * (i % (LOOP_S * 10)) / (LOOP_S * 10)
        yield i / 10, (round(start + 20 * 8192 * (1 - math.cos(turn))),)


NODES: dict[str, tuple[tuple[str, ...], Callable[[random.Random], Rows]]] = {
    "io-cia401": (("inputs_1", "inputs_2", *(f"analogue_in_{n}" for n in (1, 2, 3, 4))), io_module),
    "drive-cia402": (("torque", "dc_voltage"), drive),
    "measuring-cia404": (("pressure", "temperature"), measuring_device),
    "encoder-cia406": (("position",), encoder),
}
"""CANopen nodes: the replayed tags, and their signals."""


def main(argv: Sequence[str] | None = None) -> int:
    """Write every recording; return the exit code."""
    parser = argparse.ArgumentParser(description="make the recordings of real devices that ship with fieldtwin")
    parser.add_argument("--seed", type=int, default=DEFAULT_SEED)
    parser.add_argument("--out", type=Path, default=ROOT / "recordings")
    options = parser.parse_args(argv)
    options.out.mkdir(parents=True, exist_ok=True)
    for name in DEVICES:
        make(name, options.out, options.seed)
    for name in NODES:
        make_node(name, options.out, options.seed)
    return 0


def make(name: str, out: Path, seed: int) -> None:
    """Write NAME.jsonl: `ROUNDS` readings of every value, as recorded by a client that reads each one separately."""
    profile = load_profile(ROOT / "profiles" / "devices" / f"{name}.yaml")
    path = out / f"{name}.jsonl"
    path.unlink(missing_ok=True)
    header = RecordingHeader(
        version=1,
        device=profile.name,
        kind="exchanges",
        source="synthetic",
        made_by=f"scripts/make_device_recordings.py --seed {seed}",
        profile_hash=profile.hash,
    )
    r = random.Random(f"{name} {seed}")
    with RecordingWriter(path, header) as writer:
        for n in range(ROUNDS):
            _round(profile, DEVICES[name](r, n), n * EVERY_S, r, writer)
    print(f"{path.name}: {writer.records} exchanges", file=sys.stderr)


def make_node(name: str, out: Path, seed: int) -> None:
    """Write NAME.jsonl: the signals of a CANopen node."""
    profile = load_profile(ROOT / "profiles" / "devices" / f"{name}.yaml")
    signals, steps = NODES[name]
    path = out / f"{name}.jsonl"
    path.unlink(missing_ok=True)
    header = RecordingHeader(
        version=1,
        device=profile.name,
        kind="signals",
        source="synthetic",
        made_by=f"scripts/make_device_recordings.py --seed {seed}",
        profile_hash=profile.hash,
        signals={tag: SignalInfo(unit=profile.tags[tag].unit) for tag in signals},
    )
    with RecordingWriter(path, header) as writer:
        for t_s, values in steps(random.Random(f"{name} {seed}")):
            writer.row(t_s, values)
    print(f"{path.name}: {writer.records} rows", file=sys.stderr)


def _round(
    profile: DeviceProfile, values: Mapping[str, Value], t_s: float, r: random.Random, writer: RecordingWriter
) -> None:
    unit = profile.form.factory.unit
    for tag in profile.tags.values():
        at = tag.registers
        latency_s = round(0.012 + r.random() * 0.004, 4)
        if not tag.readable:
            if profile.form.trigger is not None and tag.name == profile.form.trigger.tag:
                data = at.address.to_bytes(2) + b"\x00\x01"
                request = b"\x10" + data + b"\x02" + profile.form.trigger.value.to_bytes(2)
                writer.exchange(RecordedExchange(round(t_s, 3), unit, request, b"\x10" + data, latency_s))
            continue
        words = encode(values[tag.name], tag.type, tag.order, registers=at.count)
        request = bytes([READ_FUNCTION[at.table]]) + at.address.to_bytes(2) + at.count.to_bytes(2)
        body = b"".join(w.to_bytes(2) for w in words)
        writer.exchange(
            RecordedExchange(round(t_s, 3), unit, request, request[:1] + bytes([len(body)]) + body, latency_s)
        )
        t_s += 0.05


if __name__ == "__main__":
    sys.exit(main())
