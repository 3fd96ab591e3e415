"""Files that a user named for output: a folder that is not there, or may not be written to, is theirs to mend, and named."""

from __future__ import annotations

from pathlib import Path

from fieldtwin.gateway.core.errors import FileInvalid


def write_text(path: Path, text: str) -> None:
    """Write `text` to `path`. Raises `FileInvalid` where that cannot be."""
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as e:
        raise FileInvalid(f"cannot write the file: {e.strerror or e}", path=str(path)) from e
