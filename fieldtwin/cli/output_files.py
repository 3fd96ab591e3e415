"""Write output files that the user named: the error for a missing folder or permission names the file."""

from __future__ import annotations

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
