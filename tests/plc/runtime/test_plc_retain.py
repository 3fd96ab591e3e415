"""RETAIN: the values of a warm start after a kill at any instant, and files that are set aside."""

from __future__ import annotations

import os
import random
import signal
import struct
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldtwin.gateway.core.image.image import TagKind
from fieldtwin.plc.binding import BoundProgram
from fieldtwin.plc.program import Program, ScanInfo, var_local, var_retain
from fieldtwin.plc.runtime.retain import Retained, RetainFile, RetainFull

KILLS = 60


class Counter(Program):
    n: int = var_retain(TagKind.INT, initial=0)
    sevenfold: int = var_retain(TagKind.INT, initial=0)
    text: str = var_local(TagKind.INT, initial=0)

    def execute(self, scan: ScanInfo) -> None:
        self.n += 1
        self.sevenfold = 7 * self.n


class Other(Program):
    n: float = var_retain(TagKind.REAL, initial=0.0)

    def execute(self, scan: ScanInfo) -> None:
        self.n += 0.5


def bound(program: Program) -> list[BoundProgram]:
    return [BoundProgram("main", program)]


def scan(program: Program, times: int = 1) -> None:
    for number in range(1, times + 1):
        program.execute(ScanInfo(number, number, number == 1))


def test_a_warm_start_continues_and_a_cold_one_starts_fresh(tmp_path: Path) -> None:
    path = tmp_path / "retain"
    first = Counter()
    kept = Retained(bound(first), path)
    assert kept.start == "cold start"
    scan(first, 5)
    kept.save()
    kept.close()
    warm = Counter()
    again = Retained(bound(warm), path)
    assert (again.start, warm.n, warm.sevenfold) == ("warm start", 5, 35)
    again.close()
    cold = Counter()
    anew = Retained(bound(cold), path, cold=True)
    assert (anew.start, cold.n) == ("cold start", 0)
    anew.close()


def test_a_different_program_starts_cold_and_the_old_file_is_kept(tmp_path: Path) -> None:
    path = tmp_path / "retain"
    kept = Retained(bound(Counter()), path)
    kept.save()
    kept.close()
    other = Other()
    begun = Retained(bound(other), path)
    assert begun.start == "cold start: the retained variables belong to a different program"
    assert (tmp_path / "retain.old").exists()
    begun.close()


@pytest.mark.parametrize("damage", [b"", b"short", b"x" * 100_000])
def test_an_invalid_file_is_set_aside(tmp_path: Path, damage: bytes) -> None:
    path = tmp_path / "retain"
    path.write_bytes(damage)
    begun = Retained(bound(Counter()), path)
    assert begun.start.startswith("cold start: ")
    assert path.with_suffix(".old").read_bytes() == damage
    begun.close()


@given(st.integers(0, 300), st.integers(0, 7))
def test_a_damaged_slot_gives_the_one_before(tmp_path_factory: pytest.TempPathFactory, at: int, bit: int) -> None:
    path = tmp_path_factory.mktemp("retain") / "file"
    file, _, _ = RetainFile.open(path, b"h" * 32, 20)
    file.save({"n": 1, "pad": "x" * 200})
    file.save({"n": 2, "pad": "y" * 200})
    file.close()
    data = bytearray(path.read_bytes())
    data[48 + min(at, 16 + 200)] ^= 1 << bit  # save 2 is in slot 0
    path.write_bytes(data)
    again, kept, aside = RetainFile.open(path, b"h" * 32, 20)
    again.close()
    assert not aside
    assert kept["n"] in (1, 2)  # 2 only if the bit is not part of the record
    assert kept["pad"] == "xy"[kept["n"] - 1] * 200


def test_data_larger_than_the_file_is_an_error_and_the_last_complete_save_stays(tmp_path: Path) -> None:
    file, _, _ = RetainFile.open(tmp_path / "f", b"h" * 32, 20)
    file.save({"s": "small"})
    with pytest.raises(RetainFull, match="4096 bytes"):
        file.save({"s": "x" * 5000})
    file.close()
    again, kept, _ = RetainFile.open(tmp_path / "f", b"h" * 32, 20)
    assert kept == {"s": "small"}
    again.close()


@pytest.mark.parametrize("kills", [KILLS, pytest.param(20 * KILLS, marks=[pytest.mark.long, pytest.mark.timeout(600)])])
def test_nothing_is_lost_or_torn_by_a_kill_at_any_instant(tmp_path: Path, kills: int) -> None:
    """Each round: a process scans, saves and prints its progress; it is killed; the next one finds that state or one newer."""
    path, rng, reached = tmp_path / "retain", random.Random(1), 0
    for _ in range(kills):
        read, write = os.pipe()
        child = os.fork()
        if child == 0:
            _scan_until_killed(path, write)
        os.close(write)
        first = _told(read)
        assert reached <= first <= reached + 1  # a save completed before it could be printed
        reached = first
        for _ in range(rng.randrange(60)):
            reached = _told(read)
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        while rest := os.read(read, 8):
            reached = struct.unpack("<q", rest)[0]
        os.close(read)
    assert reached > kills


def _told(read: int) -> int:
    return int(struct.unpack("<q", os.read(read, 8))[0])


def _scan_until_killed(path: Path, write: int) -> None:
    try:
        program = Counter()
        kept = Retained(bound(program), path)
        if program.sevenfold != 7 * program.n:
            os.write(write, struct.pack("<q", -1))  # torn
        os.write(write, struct.pack("<q", program.n))
        while True:
            scan(program)
            kept.save()
            os.write(write, struct.pack("<q", program.n))
    finally:
        os._exit(1)
