"""Write output files that the user named: the error for a missing folder or permission names the file."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from fieldtwin.gateway.core.errors import FileInvalid


def write_text(path: Path, text: str) -> None:
    """Write `text` to `path`. Raises `FileInvalid` if it cannot be written."""
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as e:
        raise FileInvalid(f"cannot write the file: {e.strerror or e}", path=str(path)) from e


def write_bytes(path: Path, data: bytes) -> None:
    """Write `data` to `path`. Raises `FileInvalid` if it cannot be written."""
    try:
        path.write_bytes(data)
    except OSError as e:
        raise FileInvalid(f"cannot write the file: {e.strerror or e}", path=str(path)) from e


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield the path of a file that becomes `path` when the block ends without an error, so that `path` is complete or unchanged.

    A device or pipe is written directly. Raises `FileInvalid` if the folder of `path` does not exist or renaming fails.
    """
    if path.exists() and not path.is_file():
        yield path
        return
    if not path.parent.is_dir():
        raise FileInvalid("cannot write the file: its folder does not exist", path=str(path))
    part = path.with_name(f".{path.name}.part")
    try:
        yield part
        part.replace(path)
    except OSError as e:
        raise FileInvalid(f"cannot write the file: {e.strerror or e}", path=str(path)) from e
    finally:
        part.unlink(missing_ok=True)
