"""Hostile files end in a typed error, within limits on memory and time, for every kind of file.

Defects: a pipe blocked every reader forever, /dev/zero and a file of 1 GB filled the memory as an EDS, as Structured Text, as
a CAN log and as the file of `run`, and an integer of 5000 digits in a YAML file ended in a traceback.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

CHILD = Path(__file__).parents[3] / "rigs" / "files" / "hostile_readers.py"
LARGE = 1 << 30


def read_all(folder: Path, *kinds: str) -> list[tuple[str, str, str, str]]:
    """The result of each attempt: reader, file, result, message."""
    ended = subprocess.run(
        [sys.executable, str(CHILD), str(folder), *kinds], capture_output=True, text=True, timeout=300, check=False
    )
    assert ended.returncode == 0, ended.stderr[-3000:]
    return [(k, n, o, s) for k, n, o, s in map(json.loads, ended.stdout.splitlines())]


def untyped(results: list[tuple[str, str, str, str]]) -> list[str]:
    return [
        f"{kind}: {name[-300:]}: {result}: {said}"
        for kind, name, result, said in results
        if result.startswith("UNTYPED")
    ]


def sparse(path: Path, head: bytes) -> None:
    """A file of 1 GB that uses no disk space."""
    with path.open("wb") as file:
        file.write(head)
        file.truncate(LARGE)


@pytest.mark.long
@pytest.mark.timeout(300)
def test_pipes_devices_links_and_endless_lines_are_refused_by_every_reader(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "odd-pipe")
    (tmp_path / "odd-link-to-zero").symlink_to("/dev/zero")
    (tmp_path / "odd-link-to-full").symlink_to("/dev/full")
    (tmp_path / "odd-link-to-itself").symlink_to("odd-link-to-itself")
    (tmp_path / "odd-link-to-nothing").symlink_to("nothing")
    (tmp_path / "odd-folder").mkdir()
    sparse(tmp_path / "odd-large", b"")
    sparse(tmp_path / "odd-large-gzip", b"\x1f\x8b\x08\0\0\0\0\0\0\0")
    sparse(tmp_path / "odd-large-zip", b"PK\x03\x04")
    sparse(tmp_path / "odd-large-xml", b"<project>")
    endless = "d4c3b2a1020004000000000000000000ffff0000e3000000" + "00" * 8 + "ff" * 8
    sparse(tmp_path / "odd-large-pcap", bytes.fromhex(endless))
    sparse(tmp_path / "odd-large-blf", b"LOGG\x90\0\0\0")
    results = read_all(tmp_path, "odd")
    assert untyped(results) == []
    for kind, name, result, _ in results:
        if "pipe" in name or "link" in name:  # no reader may consume its content
            assert result != "read" or kind in ("network or system", "import"), (kind, name)


@pytest.mark.long
@pytest.mark.timeout(300)
def test_hostile_values_at_every_place_of_every_kind_of_yaml_file(tmp_path: Path) -> None:
    results = read_all(tmp_path, "values")
    assert untyped(results) == []
    assert len({kind for kind, *_ in results}) == 9
    assert len(results) > 200
