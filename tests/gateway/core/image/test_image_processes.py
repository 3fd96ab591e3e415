"""Two processes on one image: a writer at full speed, killed at an arbitrary instant. A value is never torn."""

from __future__ import annotations

import json
import mmap
import os
import subprocess
import sys
from pathlib import Path

import pytest

from fieldtwin.gateway.core.image.image import ImageLayout, RegionLayout, RegionReader, TagKind, TagSpec, message_tag

TAGS = 334
"""Number of tags per kind, of three kinds: 1,002 mixed tags."""
READS = 10_000_000
"""Number of tags read, in whole snapshots."""
FRESH = 100
"""Minimum share of snapshots per round with a new publication; with one processor per process, 97 % are new."""
ROUNDS = 4
DEPTH = 512

# Every publication has n in all tags and one message n, so any mixture of two publications is detected.
WRITER = """
import json, mmap, sys
from fieldtwin.gateway.core.image.image import ImageLayout
from fieldtwin.gateway.core.values import Quality, Reason
layout = ImageLayout.from_description(json.loads(sys.argv[2]))
with open(sys.argv[1], "r+b") as f:
    memory = memoryview(mmap.mmap(f.fileno(), 0))
writer = layout.attach(memory).writer("r")
n = writer.counter
assert writer.last_sequence("m") == n
print("running", flush=True)
while True:
    n += 1
    values = [0] + [n, float(n), n % 2 == 0] * TAGS
    writer.publish_columns(values, Quality.GOOD, Reason.NONE, n, {"m": [(n, str(n).encode())]})
"""


@pytest.mark.parametrize(
    ("reads", "rounds"),
    [
        (READS, ROUNDS),
        pytest.param(10 * READS, 10 * ROUNDS, marks=[pytest.mark.long, pytest.mark.timeout(900)]),
    ],
)
def test_a_writer_at_full_speed_killed_again_and_again_never_tears_a_value(
    tmp_path: Path, reads: int, rounds: int
) -> None:
    kinds = [TagKind.INT, TagKind.REAL, TagKind.BOOL]
    tags = (message_tag("m", 20, DEPTH), *(TagSpec(f"t{i}", kinds[i % 3]) for i in range(3 * TAGS)))
    layout = ImageLayout((RegionLayout("r", tags),))
    path = tmp_path / "image"
    path.write_bytes(bytes(layout.size))
    with path.open("r+b") as file, mmap.mmap(file.fileno(), 0) as mapped, memoryview(mapped) as memory:
        layout.format(memory)
        with layout.attach(memory) as image:
            reader = image.reader("r")
            looks = fresh = seen = 0
            for turn in range(1, rounds + 1):
                child = _start_writer(path, layout)
                try:
                    while looks * 3 * TAGS < reads * turn / rounds or fresh < FRESH * turn:
                        before, seen = seen, _look(reader, seen)
                        looks, fresh = looks + 1, fresh + (seen != before)
                        if seen == before:
                            os.sched_yield()  # on a busy computer the writer gets CPU time
                finally:
                    child.kill()
                    child.wait()
                    assert child.stdout is not None
                    child.stdout.close()
                seen = _look(reader, seen)  # consistent right after the kill, too
            assert seen >= fresh >= FRESH * rounds
            assert reader.gave_up == 0


def _start_writer(path: Path, layout: ImageLayout) -> subprocess.Popen[str]:
    code = WRITER.replace("TAGS", str(TAGS))
    child = subprocess.Popen(
        [sys.executable, "-c", code, str(path), json.dumps(layout.describe())], stdout=subprocess.PIPE, text=True
    )
    assert child.stdout is not None
    assert child.stdout.readline() == "running\n"
    return child


def _look(reader: RegionReader, seen: int) -> int:
    """Read one snapshot: all of one publication, messages without an uncounted gap. Return the last sequence."""
    missed_before = reader.missed["m"]
    snapshot = reader.snapshot()
    n = snapshot.counter
    if n == 0:  # the writer is up and has not published yet
        return 0
    assert snapshot.t_ns == n
    assert snapshot.values == (n, *[n, float(n), n % 2 == 0] * TAGS)
    messages = snapshot.messages.get("m", ())
    assert [m.data for m in messages] == [str(m.seq).encode() for m in messages]
    sequences = [m.seq for m in messages]
    assert sequences == sorted(set(sequences))
    assert all(seen < number <= n for number in sequences)
    # Messages that the writer overwrote while this process had to wait are counted.
    assert len(messages) + reader.missed["m"] - missed_before == n - seen
    return n
