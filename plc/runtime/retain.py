"""The file of retained variables. It is written after each scan, and stays valid if the process is killed at any time.

Of a file of different programs or variables, the values of those variables are used whose program, name and declaration are the
same; the file is kept as ``.old``.

    magic, capacity            16 bytes
    hash of the layout         32 bytes: programs, their retained variables and kinds
    two slots                  counter, length, check sum, payload (MessagePack)
    declarations               length, check sum, hashes by program and variable (MessagePack); not in files of earlier versions

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
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgspec

from fieldtwin.gateway.core.errors import FieldtwinError, FileInvalid, Unreachable
from fieldtwin.plc.binding import BoundProgram
from fieldtwin.plc.status import RetainStatus

_MAGIC = b"FTRETN1\n"
_HEAD = struct.Struct("<8sQ32s")
_SLOT = struct.Struct("<QII")
_TABLE = struct.Struct("<II")
MIN_CAPACITY = 4096
MAX_CAPACITY = 16 * 1024 * 1024
OTHER_PROGRAM = "the retained variables belong to a different program"


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


Declarations = Mapping[str, Mapping[str, str]]
"""By program and retained variable: a hash of its type and of the form of its value."""


def declarations_of(programs: Sequence[BoundProgram]) -> Declarations:
    """Return the declarations of all retained variables."""
    found: dict[str, dict[str, str]] = {}
    for p in programs:
        values = p.program.retained()
        found[p.name] = {
            name: hashlib.sha256(msgspec.json.encode([kind, _form(values.get(name))])).hexdigest()[:32]
            for name, kind in p.program.retain_layout()
        }
    return found


def _form(value: Any) -> Any:
    """Return the form of retained data without its values: names, types, and counts."""
    if isinstance(value, dict):
        return {name: _form(v) for name, v in sorted(value.items())}
    if isinstance(value, list):
        return [len(value), _form(value[0]) if value else None]
    return type(value).__name__


class RetainFile:
    """The mapped file. Created by `open`; call `close` after use."""

    def __init__(self, path: Path, mapped: mmap.mmap, capacity: int, layout: bytes, declared: Declarations) -> None:
        self.path = path
        self.saves = 0
        self.layout, self.declared = layout, declared
        self._mapped = mapped
        self._memory = memoryview(mapped)
        self._capacity = capacity
        self._counter = 0
        self._last = b""

    @classmethod
    def open(
        cls, path: Path, layout: bytes, size: int, declared: Declarations | None = None
    ) -> tuple[RetainFile, Any, str]:
        """Return the file, its content, and the reason if an existing file was put aside.

        A content of None means that the file is empty and the programs start cold. Of a file of a different layout, the content
        is that of the variables whose declarations are the same in `declared`.

        `size` is the largest size of a save, in bytes. A file of a different layout, or a damaged file, is kept as
        ``.old``. Raises `Unreachable` if the file cannot be created.
        """
        aside, kept = "", None
        if path.exists():
            try:
                found = cls._attach(path)
                kept = found._newest()
                if found.layout == layout:
                    return found, kept, ""
                aside, kept = OTHER_PROGRAM, _same(kept or {}, found.declared, declared or {})
                found.close()
            except FileInvalid as e:
                aside = e.message
        made = cls.make(path, layout, size, declared or {})
        if aside:
            _copy(path, path.with_suffix(path.suffix + ".old"))
        if kept:
            made.save(kept)
            made.flush()
        made.replace()
        return made, kept, aside

    @classmethod
    def _attach(cls, path: Path) -> RetainFile:
        descriptor = os.open(path, os.O_RDWR | os.O_CLOEXEC)
        try:
            size = os.fstat(descriptor).st_size
            head = os.pread(descriptor, _HEAD.size, 0)
            if len(head) < _HEAD.size:
                raise FileInvalid("the file of retained variables is too short", path=str(path))
            magic, capacity, kept = _HEAD.unpack(head)
            if magic != _MAGIC or not cls._size(capacity) <= size <= cls._size(capacity) + MAX_CAPACITY:
                raise FileInvalid("not a file of retained variables", path=str(path))
            table = os.pread(descriptor, size - cls._size(capacity), cls._size(capacity))
            return cls(path, mmap.mmap(descriptor, size), capacity, kept, _declared(table))
        finally:
            os.close(descriptor)

    @classmethod
    def make(cls, path: Path, layout: bytes, size: int, declared: Declarations) -> RetainFile:
        """Return a new and empty file, which is not yet in the place of the one at `path`. Raises `Unreachable`."""
        capacity = max(MIN_CAPACITY, size)
        data = msgspec.msgpack.encode(declared)
        table = _TABLE.pack(len(data), zlib.crc32(data)) + data
        whole = cls._size(capacity) + len(table)
        try:
            descriptor = os.open(_new(path), os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o600)
            try:
                os.ftruncate(descriptor, whole)
                os.pwrite(descriptor, _HEAD.pack(_MAGIC, capacity, layout), 0)
                os.pwrite(descriptor, table, cls._size(capacity))
                mapped = mmap.mmap(descriptor, whole)
            finally:
                os.close(descriptor)
        except OSError as e:
            raise _no_file(path, e) from e
        return cls(path, mapped, capacity, layout, declared)

    def replace(self) -> None:
        """Put a file that `make` returned in its place, in one step. Raises `Unreachable`."""
        try:
            _new(self.path).replace(self.path)
        except OSError as e:
            raise _no_file(self.path, e) from e

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


def _new(path: Path) -> Path:
    return path.with_suffix(path.suffix + ".new")


def _copy(path: Path, to: Path) -> None:
    """Copy a file that only its owner may read. The original stays, so that a kill leaves one of both."""
    try:
        with open(to, "wb", opener=lambda name, flags: os.open(name, flags, 0o600)) as file:
            file.write(path.read_bytes())
    except OSError as e:
        raise _no_file(to, e) from e


def _no_file(path: Path, error: OSError) -> Unreachable:
    return Unreachable(f"no file for retained variables: {error.strerror or error}", where=str(path))


def _declared(table: bytes) -> Declarations:
    """Return the declarations at the end of a file; none for a damaged table, or a file of an earlier version."""
    if len(table) > _TABLE.size:
        length, check = _TABLE.unpack_from(table)
        data = table[_TABLE.size : _TABLE.size + length]
        if zlib.crc32(data) == check:
            with suppress(msgspec.MsgspecError):
                return msgspec.msgpack.decode(data, type=dict[str, dict[str, str]])
    return {}


def _same(kept: Mapping[str, Mapping[str, Any]], before: Declarations, now: Declarations) -> dict[str, Any] | None:
    """Return the values of the variables whose declarations are the same; None for none."""
    found = {}
    for program, variables in now.items():
        old = before.get(program, {})
        values = kept.get(program, {})
        found[program] = {n: values[n] for n, kind in variables.items() if n in values and old.get(n) == kind}
    return found if any(found.values()) else None


class RetainFull(FieldtwinError):
    """The retained variables do not fit their file."""


def _check(counter: int, data: bytes) -> int:
    return zlib.crc32(data, zlib.crc32(counter.to_bytes(8, "little")))


def _size_of(programs: Sequence[BoundProgram]) -> int:
    """Return the largest size of a save in bytes. Raises `FileInvalid` for more than a file can hold."""
    size = sum(10 + len(p.name.encode()) + p.program.retain_bytes() for p in programs)
    if size > MAX_CAPACITY:
        raise FileInvalid("too much is retained", expected=f"at most {MAX_CAPACITY} bytes", got=str(size))
    return size


class Retained:
    """The retained variables of all programs, and their file: restored once, saved after scans."""

    def __init__(self, programs: Sequence[BoundProgram], path: Path | None, *, cold: bool = False) -> None:
        """Open the file and restore the values, unless `cold`. Nothing is saved if `path` is None or no program retains anything.

        Raises `Unreachable` if the file cannot be created.
        """
        self._programs = [p for p in programs if p.program.retained()]
        self._path = path
        self._saves = 0
        """The saves in files that were replaced since the start."""
        self._file: RetainFile | None = None
        self.start = "no retained variables"
        if path is None or not self._programs:
            return
        declared = declarations_of(self._programs)
        self._file, kept, aside = RetainFile.open(path, layout_hash(self._programs), _size_of(self._programs), declared)
        if kept is None or cold:
            self.start = f"cold start: {aside}" if aside else "cold start"
            return
        for p in self._programs:
            p.program.restore(kept[p.name])
        fresh = [f"{p}.{name}" for p, names in declared.items() for name in names if name not in kept[p]]
        self.start = f"warm start; with initial values: {', '.join(fresh)}" if fresh else "warm start"

    def prepared(self, programs: Sequence[BoundProgram], new: Sequence[BoundProgram]) -> Callable[[], None]:
        """Return the step that makes the retained variables of `new` those that are saved. `programs` are the programs that run,
        which become `new`.

        The file with the values of `new` is complete before the step puts it in its place, so a kill at any time leaves a valid
        file. Raises `Unreachable` if the file cannot be created, and `FileInvalid` for more than a file can hold.
        """
        retained = [p for p in new if p.program.retained()]
        made: RetainFile | None = None
        if self._path is not None and retained:
            made = RetainFile.make(self._path, layout_hash(retained), _size_of(retained), declarations_of(retained))
            made.save({p.name: p.program.retained() for p in retained})
        names = {p.name for p in retained}

        def step() -> None:
            if made is not None:
                made.replace()
            elif self._path is not None and self._file is not None:  # its values must not come back later
                self._path.replace(self._path.with_suffix(self._path.suffix + ".old"))
            if self._file is not None:
                self._saves += self._file.saves
                self._file.close()
            self._file, self._programs = made, [p for p in programs if p.name in names]

        return step

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
        return RetainStatus(start=self.start, saves=self._saves + (self._file.saves if self._file else 0))

    def values(self) -> dict[str, Any]:
        """Return the present retained values by program and variable, as plain data."""
        return self._values() if self._file else {}
