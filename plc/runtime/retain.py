"""The file of retained variables. It is written after each scan, and stays valid if the process is killed at any time.

A file of different programs or variables is not used.

    magic, capacity            16 bytes
    hash of the layout         32 bytes: programs, their retained variables and kinds
    two slots                  counter, length, check sum, payload (MessagePack)

A save goes into the older slot and is a copy into mapped memory, so it does not wait for the disk. A process that is
killed during a save leaves that slot with a wrong check sum and the other slot intact. `flush` writes the memory to the
disk, for a host that may lose power; it must be called between scans.
"""

from __future__ import annotations

import hashlib
import mmap
import os
import struct
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec

from fieldtwin.gateway.core.errors import FieldtwinError, FileInvalid, Unreachable
from fieldtwin.plc.binding import BoundProgram
from fieldtwin.plc.status import RetainStatus

_MAGIC = b"FTRETN1\n"
_HEAD = struct.Struct("<8sQ32s")
_SLOT = struct.Struct("<QII")
MIN_CAPACITY = 4096
MAX_CAPACITY = 16 * 1024 * 1024


def layout_hash(programs: Sequence[BoundProgram]) -> bytes:
    """Return the hash of all properties that must be unchanged for a saved value to keep its meaning: programs, variables, and
    the types and structure of their values.
    """
    described = [
        [
            p.name,
            p.program.retain_layout(),
            _form(p.program.retained()),
        ]
        for p in programs
    ]
    return hashlib.sha256(msgspec.json.encode(described)).digest()


def _form(value: Any) -> Any:
    """Return the form of retained data without its values: names, types, and counts."""
    if isinstance(value, dict):
        return {name: _form(v) for name, v in sorted(value.items())}
    if isinstance(value, list):
        return [len(value), _form(value[0]) if value else None]
    return type(value).__name__


class RetainFile:
    """The mapped file. Created by `open`; call `close` after use."""

    def __init__(self, path: Path, mapped: mmap.mmap, capacity: int) -> None:
        self.path = path
        self.saves = 0
        self._mapped = mapped
        self._memory = memoryview(mapped)
        self._capacity = capacity
        self._counter = 0
        self._last = b""

    @classmethod
    def open(cls, path: Path, layout: bytes, size: int) -> tuple[RetainFile, Any, str]:
        """Return the file, its content, and the reason if an existing file was put aside.

        A content of None means that the file is empty and the programs start cold.

        `size` is the largest size of a save, in bytes. A file of a different layout, or a damaged file, is kept as
        ``.old``. Raises `Unreachable` if the file cannot be created, and `FileInvalid` if `size` is more than a file
        can hold.
        """
        aside = ""
        if path.exists():
            try:
                found = cls._attach(path, layout)
                kept = found._newest()
                return found, kept, ""
            except FileInvalid as e:
                aside = e.message
                path.replace(path.with_suffix(path.suffix + ".old"))
        if size > MAX_CAPACITY:
            raise FileInvalid("too much is retained", expected=f"at most {MAX_CAPACITY} bytes", got=str(size))
        return cls._make(path, layout, max(MIN_CAPACITY, size)), None, aside

    @classmethod
    def _attach(cls, path: Path, layout: bytes) -> RetainFile:
        descriptor = os.open(path, os.O_RDWR | os.O_CLOEXEC)
        try:
            size = os.fstat(descriptor).st_size
            head = os.pread(descriptor, _HEAD.size, 0)
            if len(head) < _HEAD.size:
                raise FileInvalid("the file of retained variables is too short", path=str(path))
            magic, capacity, kept = _HEAD.unpack(head)
            if magic != _MAGIC or size != cls._size(capacity):
                raise FileInvalid("not a file of retained variables", path=str(path))
            if kept != layout:
                raise FileInvalid("the retained variables belong to a different program", path=str(path))
            return cls(path, mmap.mmap(descriptor, size), capacity)
        finally:
            os.close(descriptor)

    @classmethod
    def _make(cls, path: Path, layout: bytes, capacity: int) -> RetainFile:
        beside = path.with_suffix(path.suffix + ".new")
        try:
            descriptor = os.open(beside, os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o600)
            try:
                os.ftruncate(descriptor, cls._size(capacity))
                os.pwrite(descriptor, _HEAD.pack(_MAGIC, capacity, layout), 0)
                mapped = mmap.mmap(descriptor, cls._size(capacity))
            finally:
                os.close(descriptor)
            beside.replace(path)
        except OSError as e:
            raise Unreachable(f"no file for retained variables: {e.strerror or e}", where=str(path)) from e
        return cls(path, mapped, capacity)

    @staticmethod
    def _size(capacity: int) -> int:
        return _HEAD.size + 2 * (_SLOT.size + capacity)

    def _offset(self, counter: int) -> int:
        return _HEAD.size + (counter & 1) * (_SLOT.size + self._capacity)

    def _newest(self) -> Any:
        """Return the payload with the highest counter whose check sum is correct; None if nothing was ever saved."""
        best, data = 0, b""
        for slot in (0, 1):
            at = self._offset(slot)
            counter, length, check = _SLOT.unpack_from(self._memory, at)
            if counter > best and length <= self._capacity:
                payload = bytes(self._memory[at + _SLOT.size : at + _SLOT.size + length])
                if _check(counter, payload) == check:
                    best, data = counter, payload
        self._counter, self._last = best, data
        if not best:
            return None
        try:
            return msgspec.msgpack.decode(data)
        except msgspec.MsgspecError as e:
            self.close()
            raise FileInvalid("retained variables that cannot be read", path=str(self.path)) from e

    def save(self, values: Any) -> bool:
        """Save `values`. Return False if they equal those saved last. Raises `RetainFull` if they are too large."""
        try:
            data = msgspec.msgpack.encode(values)
        except (TypeError, OverflowError, msgspec.MsgspecError) as e:
            raise RetainFull(
                f"a retained variable holds a value that cannot be retained: {e}", where=str(self.path)
            ) from e
        if data == self._last:
            return False
        if len(data) > self._capacity:
            raise RetainFull(
                "the retained variables need more room than their file has",
                expected=f"at most {self._capacity} bytes", got=str(len(data)), where=str(self.path),
            )  # fmt: skip
        counter = self._counter + 1
        at = self._offset(counter)
        start = at + _SLOT.size
        _SLOT.pack_into(self._memory, at, 0, 0, 0)  # not valid from here until its head is written
        self._memory[start : start + len(data)] = data
        _SLOT.pack_into(self._memory, at, counter, len(data), _check(counter, data))
        self._counter, self._last = counter, data
        self.saves += 1
        return True

    def flush(self) -> None:
        """Write the file to the disk. Blocks."""
        self._mapped.flush()

    def close(self) -> None:
        self._memory.release()
        self._mapped.close()


class RetainFull(FieldtwinError):
    """The retained variables do not fit their file."""


def _check(counter: int, data: bytes) -> int:
    return zlib.crc32(data, zlib.crc32(counter.to_bytes(8, "little")))


class Retained:
    """The retained variables of all programs, and their file: restored once, saved after scans."""

    def __init__(self, programs: Sequence[BoundProgram], path: Path | None, *, cold: bool = False) -> None:
        """Open the file and restore the values, unless `cold`. Nothing is saved if `path` is None or no program retains anything.

        Raises `Unreachable` if the file cannot be created.
        """
        self._programs = [p for p in programs if p.program.retained()]
        self._file: RetainFile | None = None
        self.start = "no retained variables"
        if path is None or not self._programs:
            return
        size = sum(10 + len(p.name.encode()) + p.program.retain_bytes() for p in self._programs)
        self._file, kept, aside = RetainFile.open(path, layout_hash(self._programs), size)
        if kept is None or cold:
            self.start = f"cold start: {aside}" if aside else "cold start"
        else:
            for p in self._programs:
                p.program.restore(kept[p.name])
            self.start = "warm start"

    def _values(self) -> dict[str, Any]:
        return {p.name: p.program.retained() for p in self._programs}

    def save(self) -> None:
        """Save the values. Called after a scan, outside of its measured time. Raises `RetainFull`."""
        if self._file is not None:
            self._file.save(self._values())

    def flush(self) -> None:
        if self._file is not None:
            self._file.flush()

    def close(self) -> None:
        """Write the file to the disk and close it."""
        if self._file is not None:
            self._file.flush()
            self._file.close()
            self._file = None

    def status(self) -> RetainStatus:
        """Return the kind of the last start and the number of saves."""
        return RetainStatus(start=self.start, saves=self._file.saves if self._file else 0)

    def values(self) -> dict[str, Any]:
        """Return the present retained values by program and variable, as plain data."""
        return self._values() if self._file else {}
