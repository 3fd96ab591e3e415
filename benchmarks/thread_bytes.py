#!/usr/bin/env python3
"""The bytes of a sample on the modems' link: a thread, against JSON and Avro.

    benchmarks/thread_bytes.py [--samples 6000]

The samples are those of a CTD and an inclinometer: five tags a second, each with number, time, name, value and quality. A
thread packs them into messages of 64 bytes, with numbers and times in each; JSON is one compact line per sample, Avro
(fastavro) a record per sample with names as numbers, both without any transport overhead. No time is measured, so the figures
are the same on every computer. The exit status is 1 if a goal is missed, 2 without fastavro.
"""

from __future__ import annotations

import argparse
import io
import json
import math
import sys

from peers import Goals

from fieldtwin.gateway.store.event import Event
from fieldtwin.twin.thread.frames import Data, FrameCodec, Hello, Schema

MTU = 64
LINK_BYTES_PER_S, OVERHEAD = 80, 8
TAGS = ("ctd.pressure", "ctd.temperature", "ctd.conductivity", "inclinometer.slope_long", "inclinometer.slope_lateral")
AVRO = {
    "type": "record",
    "name": "Sample",
    "fields": [
        {"name": "sequence", "type": "long"},
        {"name": "t_ms", "type": "long"},
        {"name": "tag", "type": "int"},
        {"name": "value", "type": ["null", "float", "double", "long", "string"]},
        {"name": "quality", "type": "int"},
    ],
}


def made(count: int) -> list[Event]:
    """Single-precision values, as the devices have them, with the jitter of polling in their times."""
    import struct

    def single(value: float) -> float:
        return float(struct.unpack(">f", struct.pack(">f", value))[0])

    return [
        Event(
            100_000 + i,
            1_790_000_000_000 + (i // 5) * 1000 + (i * 37) % 90,
            0,
            TAGS[i % 5],
            single(10 + math.sin(i / 50)),
        )
        for i in range(count)
    ]


def thread(events: list[Event]) -> tuple[int, int]:
    """Return bytes and messages of a thread."""
    codec = FrameCodec([Schema(TAGS)], MTU)
    hello = Hello("plant:5f3a91c2", Schema(TAGS).id, 1, events[-1].sequence, True)
    codec.encode(hello)
    size = count = at = 0
    while at < len(events):
        fit = codec.fit(hello.tag, events[at:])
        for datagram in codec.encode(Data(hello.tag, tuple(events[at : at + fit]))):
            size += len(datagram)
            count += 1
        at += fit
    return size, count


def as_json(events: list[Event]) -> int:
    return sum(
        len(
            json.dumps(
                {"seq": e.sequence, "t": e.t_ms, "tag": e.name, "value": e.value, "quality": e.quality},
                separators=(",", ":"),
            )
        )
        for e in events
    )


def as_avro(events: list[Event]) -> int:
    import fastavro

    schema, out = fastavro.parse_schema(AVRO), io.BytesIO()
    for e in events:
        record = {
            "sequence": e.sequence,
            "t_ms": e.t_ms,
            "tag": TAGS.index(e.name),
            "value": ("float", e.value),
            "quality": 0,
        }
        fastavro.schemaless_writer(out, schema, record)
    return out.tell()


def main() -> int:
    parser = argparse.ArgumentParser(description="bytes a sample on the modems' link")
    parser.add_argument("--samples", type=int, default=6000)
    parser.add_argument("--quick", action="store_true", help="few samples")
    options = parser.parse_args()
    events = made(500 if options.quick else options.samples)
    try:
        avro = as_avro(events)
    except ImportError:
        print("no fastavro (pip install fastavro)", file=sys.stderr)
        return 2
    size, messages = thread(events)
    sizes = {"thread": size, "avro": avro, "json": as_json(events)}
    print(f"{len(events)} samples of five tags")
    for name, total in sizes.items():
        print(f"{name:<8} {total / len(events):6.1f} bytes a sample   {total / size:5.2f} of the thread's")
    on_air = (size + messages * OVERHEAD) / LINK_BYTES_PER_S
    print(
        f"{len(events) / messages:.1f} samples a message; at {LINK_BYTES_PER_S} B/s {len(events) / on_air:.1f} samples a second"
    )
    goals = Goals(timed=False)
    goals.most("bytes a sample, of Avro's", size / avro, 1.0, "")
    goals.most("bytes a sample, of JSON's", size / sizes["json"], 0.2, "")
    return goals.verdict()


if __name__ == "__main__":
    sys.exit(main())
