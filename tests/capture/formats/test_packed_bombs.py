"""A small packed file that expands to a gigabyte ends with a typed error at a stated size, in every reader.

Defect: memory was bounded but time was not: a capture of 2 MiB could keep `import` busy for hours.
"""

from __future__ import annotations

import bz2
import gzip
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import pytest

from fieldtwin.capture.formats import packed
from fieldtwin.capture.formats.can_files import read_can_file
from fieldtwin.capture.formats.cnv import import_cnv
from fieldtwin.capture.formats.packet_file import PacketFile
from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.core.files.candump import LeftOut

PIECE = 16 << 20
PIECES = 64
"""1 GiB in total, made of one compressed piece that is repeated."""
PCAP = bytes.fromhex("d4c3b2a1 0200 0400 00000000 00000000 00000400 01000000")
PCAPNG = bytes.fromhex("0a0d0d0a 1c000000 4d3c2b1a 01000000 ffffffffffffffff 1c000000")
PACKET = struct.pack("<IIII", 0, 0, 65536 - 16, 65536 - 16) + bytes(65536 - 16)
BLOCK = struct.pack("<II", 0xBAD, 65536) + bytes(65536 - 12) + struct.pack("<I", 65536)
CAST = b"* Sea-Bird SBE 9 Data File:\n# nquan = 4\n# name 0 = timeS:\n# name 1 = prDM:\n# name 2 = t090C:\n# name 3 = c0S/m:\n"
PACK: dict[str, Callable[[bytes], bytes]] = {"gz": lambda d: gzip.compress(d, 6, mtime=0), "bz2": bz2.compress}
BOMBS = {
    "pcap of large packets": (PCAP, PACKET),
    "pcapng of unknown blocks": (PCAPNG, BLOCK),
    "cast whose header goes on": (CAST, b"* " + b"x" * 65_000 + b"\n"),
    "cast of long lines": (CAST + b"*END*\n", b" " * 65_000 + b"\n"),
}


def read(path: Path) -> None:
    if "cast" in path.name:
        import_cnv(path, path.with_name("out.jsonl"))
        return
    with PacketFile(path) as file:
        for _ in file:
            pass


@pytest.fixture(autouse=True)
def no_bomb_is_kept(tmp_path: Path):  # type: ignore[no-untyped-def]
    yield
    for path in tmp_path.iterdir():
        path.unlink()


@pytest.mark.parametrize("how", sorted(PACK))
@pytest.mark.parametrize("kind", sorted(BOMBS))
def test_a_packed_file_of_a_gigabyte_ends_at_the_stated_size(tmp_path: Path, kind: str, how: str) -> None:
    head, unit = BOMBS[kind]
    piece = PACK[how](unit * (PIECE // len(unit)))
    path = tmp_path / f"{kind}.{how}"
    with path.open("wb") as file:
        file.write(PACK[how](head))
        for _ in range(PIECES):
            file.write(piece)
    assert path.stat().st_size < PIECE * PIECES // 200
    with pytest.raises(FileInvalid, match=r"the unpacked file is too large.*at most \d+ bytes \(64 MiB, or 100 times"):
        read(path)


def test_a_can_log_whose_containers_hold_gigabytes_ends_at_the_stated_size(tmp_path: Path) -> None:
    """A BLF file packs its frames in containers; each container is small enough by itself."""
    objects = struct.pack("<4sHHII", b"LOBJ", 32, 1, 1 << 15, 0) + bytes((1 << 15) - 16)
    body = zlib.compress(objects * (PIECE // 16 // len(objects)))
    container = struct.pack("<4sHHIIHHIII", b"LOBJ", 16, 1, 32 + len(body), 10, 2, 0, 0, PIECE // 16, 0) + body
    container += bytes(len(container) % 4)
    path = tmp_path / "bomb.blf"
    path.write_bytes(b"LOGG" + struct.pack("<I", 144) + bytes(136) + container * (PIECES * 32))
    with pytest.raises(FileInvalid, match="the unpacked file is too large"):
        for _ in read_can_file(path, LeftOut()):
            pass


def test_an_honest_file_may_hold_many_times_its_size(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(packed, "FREE_BYTES", 1 << 20)
    data = PCAP + PACKET * 17  # a little more than 1 MiB, in some kilobytes
    path = tmp_path / "capture"
    path.write_bytes(gzip.compress(data))
    with pytest.raises(FileInvalid, match="unpack it"):
        read(path)
    path.write_bytes(data)
    read(path)  # unpacked it is an ordinary file
    monkeypatch.setattr(packed, "MOST_TIMES", 2000)
    path.write_bytes(gzip.compress(data))
    read(path)
