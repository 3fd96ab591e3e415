"""Read CAN logs of other programs (Vector's .asc and .blf, PEAK's .trc) through python-can's readers, as frames with times.

The module uses only the readers of python-can: no interface is opened. The readers do not check a file. Therefore this module
checks the size of lines and packed blocks before they are read, and the frames afterwards, and translates every error of the
readers into `FileInvalid`. CAN FD and error frames are counted and omitted. These formats lose data: .trc has no error
frames, and the times in .asc and .blf are those that the writing program chose.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

from fieldtwin.capture.formats.packed import most_unpacked, too_much
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.errors import FieldtwinError, FileInvalid, UsageError
from fieldtwin.gateway.core.files.candump import LeftOut
from fieldtwin.gateway.core.files.input_file import open_input

SUFFIXES = (".asc", ".blf", ".trc")
MAX_TIME_S = 1 << 33
MAX_LINE = 65_536
MAX_CONTAINER = 16_000_000
"""Maximum unpacked size in bytes of a packed block of a .blf file; writers end a block at a hundredth of it."""
_BLOCK = 65_536
_CONTAINER, _PLAIN, _ZLIB = 10, 0, 2
MAX_OBJECT = 65_536


def read_can_file(path: Path, left: LeftOut) -> Iterator[tuple[int, str, CanFrame]]:
    """Yield (ns, channel, frame) in the file's order. Raises `FileInvalid` with the number of the message if known."""
    try:
        from can.io.asc import ASCReader
        from can.io.blf import BLFReader
        from can.io.trc import TRCReader
    except ImportError as e:
        raise UsageError("python-can is not installed", hint="pip install python-can") from e
    kind = path.suffix.lower()
    readers: dict[str, Any] = {".asc": ASCReader, ".blf": BLFReader, ".trc": TRCReader}
    number = 0
    try:
        (_check_blocks if kind == ".blf" else _check_lines)(path)
        with open_input(path) if kind == ".blf" else path.open(encoding="utf-8", errors="replace") as file:
            for message in _guarded(readers[kind], file, path):
                number += 1
                found = _frame(message, left)
                if found is not None:
                    yield found
    except OSError as e:
        raise FileInvalid(f"cannot read the log: {e.strerror or e}", path=str(path)) from e
    except FieldtwinError as e:
        if isinstance(e, FileInvalid) and e.path:
            raise
        raise FileInvalid(f"message {number}: {e.message}", path=str(path), got=e.got) from e


def _guarded(reader: Any, file: IO[Any], path: Path) -> Iterator[Any]:
    """Yield python-can's messages of a file.

    Any exception becomes a `FileInvalid`, because the readers raise exceptions of any class for an invalid file.
    """
    number = 0
    try:
        messages = iter(reader(file))
    except Exception as e:
        raise FileInvalid(f"not a {path.suffix} file: {e or type(e).__name__}", path=str(path)) from e
    while True:
        try:
            message = next(messages)
        except StopIteration:
            return
        except Exception as e:
            said = f"after message {number}: not a {path.suffix} file: {e or type(e).__name__}"
            raise FileInvalid(said, path=str(path)) from e
        number += 1
        yield message


def _check_lines(path: Path) -> None:
    """Check the length of each line, because a reader loads a line into memory whatever its length."""
    since = number = 0
    with open_input(path) as file:
        while block := file.read(_BLOCK):
            for i, piece in enumerate(block.split(b"\n")):
                since, number = (since + len(piece), number) if i == 0 else (len(piece), number + 1)
                if since > MAX_LINE:
                    raise FileInvalid(
                        "the line is too long", path=str(path), line=number + 1, expected=f"{MAX_LINE} bytes"
                    )


def _check_blocks(path: Path) -> None:
    """Check the size of each container, because a reader unpacks it into memory whatever its size."""
    with open_input(path) as file:
        head = file.read(8)
        if len(head) < 8 or head[:4] != b"LOGG":
            raise FileInvalid("offset 0: not a .blf file", path=str(path), expected="LOGG", got=head[:4].hex())
        at, rest = max(int.from_bytes(head[4:8], "little"), 8), b""
        on_disk, held = os.fstat(file.fileno()).st_size, 0
        while True:
            file.seek(at)
            head = file.read(32)
            if len(head) < 32 or head[:4] != b"LOBJ":
                return
            size, kind = struct.unpack_from("<II", head, 8)
            if size < 32 or size > MAX_CONTAINER:
                raise FileInvalid(f"offset {at}: an object of impossible length", path=str(path), got=str(size))
            if kind == _CONTAINER and head[16] in (_PLAIN, _ZLIB):
                packed = file.read(size - 32)
                data = packed
                if head[16] == _ZLIB:
                    try:
                        data = zlib.decompressobj().decompress(packed, MAX_CONTAINER + 1)
                    except zlib.error as e:
                        raise FileInvalid(f"offset {at}: a container that is damaged: {e}", path=str(path)) from e
                if len(data) > MAX_CONTAINER:
                    raise FileInvalid(
                        f"offset {at}: a container that is too large", path=str(path), expected=f"{MAX_CONTAINER} bytes"
                    )
                held += len(data)
                if held > most_unpacked(on_disk):
                    raise too_much(path, on_disk)
                rest = _check_objects(rest + data, path, at)
            at += size + size % 4


def _check_objects(data: bytes, path: Path, container_at: int) -> bytes:
    """Check that the size of each object lets a reader advance to the next object and reach the end.

    Returns the bytes of an object that continues in the next container.
    """
    at = 0
    while (found := data.find(b"LOBJ", at, at + 8)) >= 0 and found + 16 <= len(data):
        (size,) = struct.unpack_from("<I", data, found + 8)
        if not 32 <= size <= MAX_OBJECT:
            raise FileInvalid(
                f"offset {container_at}: the container has an object of impossible length", path=str(path),
                expected=f"32 to {MAX_OBJECT} bytes", got=str(size),
            )  # fmt: skip
        if found + size > len(data):
            break
        at = found + size
    return data[at:][:MAX_OBJECT]


def _frame(message: Any, left: LeftOut) -> tuple[int, str, CanFrame] | None:
    if message.is_fd or len(message.data or b"") > 8 or message.dlc > 8:
        left.fd += 1
        return None
    if message.is_error_frame:
        left.errors += 1
        return None
    t_s = float(message.timestamp)
    if not 0 <= t_s < MAX_TIME_S:
        raise FileInvalid("an invalid time", got=str(t_s))
    remote = bool(message.is_remote_frame)
    frame = CanFrame(
        message.arbitration_id, b"" if remote else bytes(message.data), extended=bool(message.is_extended_id),
        remote=remote, dlc=message.dlc if remote else -1,
    )  # fmt: skip
    channel = "" if message.channel is None else str(message.channel)
    return round(t_s * 1e6) * 1000, f"can{channel}" if channel.isdigit() or not channel else channel, frame
