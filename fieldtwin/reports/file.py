"""Write reports to files. A missing folder is created, because a CI job's first report has none."""

from __future__ import annotations

from pathlib import Path

from fieldtwin.gateway.core.errors import FileInvalid


def put(path: Path, content: str | bytes) -> None:
    """Write the file. Raises `FileInvalid` if that is not possible."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
    except OSError as e:
        raise FileInvalid(f"cannot write the report: {e.strerror or e}", path=str(path)) from e
