"""Stores of SQLite and PostgreSQL on a full or read-only disk: a typed error, and nothing is lost or written twice.

The disk is a tmpfs of 256 KiB, or a file system in a file that turns read-only as after a disk fault, so the tests need root.
Defect: a full disk at the start was reported as a file that is not a store.
"""

from __future__ import annotations

import asyncio
import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import closing, suppress
from pathlib import Path
from sqlite3 import connect

import pytest
from local_postgres import cluster

from fieldtwin.gateway.core.errors import FieldtwinError, Unreachable
from fieldtwin.gateway.store.event import Event, Kind, KnowledgeStore, StoreFull
from fieldtwin.gateway.store.exchange_log import ExchangeLog
from fieldtwin.gateway.store.knowledge import open_knowledge

SIZE = "256k"


def mount(*words: str) -> bool:
    try:
        return subprocess.run(["mount", *words], capture_output=True, check=False, timeout=10).returncode == 0
    except FileNotFoundError:
        return False


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    place = tmp_path / "disk"
    place.mkdir()
    if not mount("-t", "tmpfs", "-o", f"size={SIZE}", "fieldtwin-test", str(place)):
        pytest.skip("no right to mount a small disk")
    try:
        yield place
    finally:
        subprocess.run(["umount", "-l", str(place)], check=True, timeout=10)


def fill(disk: Path) -> Path:
    ballast = disk / "ballast"
    with ballast.open("wb", buffering=0) as file, suppress(OSError):
        while True:
            file.write(bytes(4096))
    return ballast


def sequences(path: Path) -> list[int]:
    with closing(connect(path)) as db:
        return [row[0] for row in db.execute("SELECT sequence FROM exchange ORDER BY id")]


def test_the_exchange_log_keeps_its_rows_and_writes_each_once_when_a_full_disk_has_room_again(disk: Path) -> None:
    log = ExchangeLog(disk / "s", system="x", prototype=True)
    log.append([("t", 1, 1, bytes(100))])
    assert log.flush() == 1
    ballast = fill(disk)
    log.append([("t", n, n, bytes(200)) for n in range(2, 202)])
    for _ in range(3):
        with pytest.raises(Unreachable, match="cannot write the exchange log"):
            log.flush()
    ballast.unlink()
    assert log.flush() == 200
    log.close()
    assert log.dropped == 0
    assert sequences(disk / "s") == list(range(1, 202))


@pytest.mark.parametrize("how", ["full", "read-only"])
def test_a_store_that_cannot_be_made_is_reported_as_the_disks_fault(disk: Path, how: str) -> None:
    if how == "full":
        fill(disk)
    else:
        assert mount("-o", "remount,ro", str(disk))
    with pytest.raises(Unreachable, match="cannot open the exchange log"):
        ExchangeLog(disk / "s", system="x", prototype=True)
    with pytest.raises(FieldtwinError):
        asyncio.run(open_knowledge(str(disk / "k")))


# -- a disk that turns read-only while stores are open ---------------------------------------------------------------------


class FaultyDisk:
    """An ext4 file system in a file. `fault` makes the kernel turn it read-only under open files, as after a disk fault."""

    def __init__(self, image: Path, place: Path, mebibytes: int) -> None:
        self.place, self._image = place, image
        place.mkdir()
        with image.open("wb") as file:
            file.truncate(mebibytes << 20)
        subprocess.run(["mkfs.ext4", "-q", "-m", "0", str(image)], check=True, capture_output=True, timeout=30)

    def mount(self) -> bool:
        return mount("-o", "loop,errors=remount-ro", str(self._image), str(self.place))

    def fault(self) -> None:
        table = (line.split() for line in Path("/proc/mounts").read_text().splitlines())
        device = next(words[0] for words in table if words[1] == str(self.place))
        os.sync()  # data written before the fault is on the disk
        Path(f"/sys/fs/ext4/{Path(device).name}/trigger_fs_error").write_text("a test")
        with pytest.raises(OSError):
            (self.place / "anything").write_text("x")

    def unmount(self) -> None:
        subprocess.run(["umount", str(self.place)], capture_output=True, check=False, timeout=10)

    def repair(self) -> None:
        """The procedure after such a fault: unmount, check, mount again."""
        self.unmount()
        subprocess.run(["e2fsck", "-fy", str(self._image)], capture_output=True, check=False, timeout=30)
        assert self.mount()


def faulty(mebibytes: int) -> Iterator[FaultyDisk]:
    folder = Path(tempfile.mkdtemp(prefix="ftdisk.", dir="/tmp"))
    folder.chmod(0o755)  # the PostgreSQL server runs as a different user
    try:
        try:
            made = FaultyDisk(folder / "image", folder / "disk", mebibytes)
        except (FileNotFoundError, subprocess.CalledProcessError):
            pytest.skip("no mkfs.ext4 here")
        if not made.mount():
            pytest.skip("no right to mount a file system in a file")
        try:
            if not list(Path("/sys/fs/ext4").glob("*/trigger_fs_error")):
                pytest.skip("this kernel makes no ext4 read-only on request")
            yield made
        finally:
            made.unmount()
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture
def small_faulty() -> Iterator[FaultyDisk]:
    yield from faulty(8)


@pytest.fixture
def large_faulty() -> Iterator[FaultyDisk]:
    yield from faulty(96)


def test_a_disk_that_turns_read_only_under_an_open_exchange_log_loses_and_doubles_nothing(
    small_faulty: FaultyDisk,
) -> None:
    path = small_faulty.place / "s"
    log = ExchangeLog(path, system="x", prototype=True)
    rows = [("t", n, n, bytes(100)) for n in range(1, 31)]
    log.append(rows[:10])
    assert log.flush() == 10
    small_faulty.fault()
    log.append(rows[10:20])
    for _ in range(3):
        with pytest.raises(Unreachable, match="cannot write the exchange log"):
            log.flush()
    log.append(rows[20:])
    assert (log.waiting, log.dropped, log.stored) == (20, 0, 10)
    with pytest.raises(Unreachable):
        log.close()
    small_faulty.repair()
    assert sequences(path) == list(range(1, 11))
    log = ExchangeLog(path, system="x", prototype=True)
    log.append(rows)
    log.close()
    assert sequences(path) == list(range(1, 31))


def value(n: int, size: int = 8) -> Event:
    return Event(0, n, Kind.VALUE, "t", f"{n:06d}".ljust(size, "x"))


async def numbers(store: KnowledgeStore, origin: str) -> list[int]:
    return [event.sequence for event in await store.read(origin, 1, 1_000_000)]


def test_a_disk_that_turns_read_only_under_open_knowledge_is_unreachable_and_keeps_its_data(
    small_faulty: FaultyDisk,
) -> None:
    async def main() -> None:
        url = str(small_faulty.place / "k.db")
        store = await open_knowledge(url)
        origin = await store.own("plant", system="x", prototype=True, log="aa")
        assert await store.append(origin, [value(n) for n in range(50)]) == 50
        small_faulty.fault()
        for _ in range(3):
            with pytest.raises(Unreachable):
                await store.append(origin, [value(50)])
        with suppress(Unreachable):
            await store.aclose()
        small_faulty.repair()
        store = await open_knowledge(url)
        assert await numbers(store, origin) == list(range(1, 51))
        assert await store.append(origin, [value(50)]) == 51
        await store.aclose()

    asyncio.run(main())


# -- PostgreSQL ---------------------------------------------------------------------------------------------------------------


async def until_written(store: KnowledgeStore, origin: str) -> int:
    """The server recovers automatically after a moment."""
    deadline = time.monotonic() + 40
    while True:
        try:
            return await store.append(origin, [value(0)])
        except Unreachable:
            assert time.monotonic() < deadline
            await asyncio.sleep(0.2)


@pytest.mark.long
@pytest.mark.interop
@pytest.mark.timeout(180)
def test_postgresql_on_a_full_disk_is_a_typed_error_and_continues_when_there_is_room(large_faulty: FaultyDisk) -> None:
    async def main(url: str) -> None:
        store = await open_knowledge(url)
        origin = await store.own("plant", system="x", prototype=True, log="aa")
        last = await store.append(origin, [value(n) for n in range(100)])
        ballast = fill(large_faulty.place)
        refused: list[Unreachable] = []
        for _ in range(400):  # 40 MB: more than the free space in the existing files
            try:
                last = await store.append(origin, [value(n, 1000) for n in range(100)])
            except Unreachable as e:
                refused.append(e)
                if isinstance(e, StoreFull) or len(refused) > 3:
                    break
        assert refused
        ballast.unlink()
        written = await until_written(store, origin)
        known = await numbers(store, origin)
        assert written > last
        assert known == sorted(set(known))
        assert set(range(1, last + 1)) <= set(known), "what was acknowledged is there"
        assert await store.gaps(origin) == []
        await store.aclose()

    with cluster(large_faulty.place) as made:
        asyncio.run(main(made.url))


@pytest.mark.long
@pytest.mark.interop
@pytest.mark.timeout(180)
def test_postgresql_on_a_disk_that_turns_read_only_is_a_typed_error_and_keeps_acknowledged_data(
    large_faulty: FaultyDisk,
) -> None:
    async def before(url: str) -> tuple[str, int]:
        store = await open_knowledge(url)
        origin = await store.own("plant", system="x", prototype=True, log="aa")
        last = await store.append(origin, [value(n) for n in range(100)])
        db = store._db  # type: ignore[attr-defined]
        await db.execute("CHECKPOINT")  # fsync is off in this cluster: a disk fault loses unwritten data
        large_faulty.fault()
        refused = 0
        for n in range(20):
            try:
                last = await store.append(origin, [value(n, 1000) for n in range(2000)])
            except Unreachable:
                refused += 1
                if refused == 3:
                    break
        assert refused == 3
        await store.aclose()
        with pytest.raises(Unreachable):
            await open_knowledge(url.replace("/postgres?", "/fieldtwin_of_a_test?"))
        return origin, last

    async def after(url: str, origin: str, last: int) -> None:
        store = await open_knowledge(url)
        known = await numbers(store, origin)
        assert known == list(range(1, len(known) + 1))
        assert len(known) >= min(last, 100)
        assert await store.append(origin, [value(0)]) == len(known) + 1
        await store.aclose()

    with cluster(large_faulty.place) as made:
        origin, last = asyncio.run(before(made.url))
        with suppress(subprocess.CalledProcessError):
            made.stop()
        large_faulty.repair()
        made.start()
        asyncio.run(after(made.url, origin, last))
