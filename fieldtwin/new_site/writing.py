"""Write the files of a new site into an empty folder. If that fails, the folder is left as it was before."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from fieldtwin.gateway.core.errors import UsageError

ALLOWED = {".git"}
"""Files and folders that may exist in a folder that counts as empty."""
_SHOWN = 3


def check_empty(folder: Path) -> None:
    """Raise `UsageError` if the folder exists and is not empty, or is a file."""
    if (folder.is_symlink() and not folder.exists()) or (folder.exists() and not folder.is_dir()):
        raise UsageError("not a folder", where=str(folder), expected="a new or an empty folder")
    if not folder.exists():
        return
    try:
        present = sorted(entry.name for entry in folder.iterdir() if entry.name not in ALLOWED)
    except OSError as e:
        raise UsageError(f"cannot be read: {e.strerror or e}", where=str(folder)) from e
    if present:
        more = f" and {len(present) - _SHOWN} more" if len(present) > _SHOWN else ""
        raise UsageError(
            "the folder is not empty",
            where=str(folder),
            expected="a new or an empty folder",
            got=", ".join(present[:_SHOWN]) + more,
            hint=f"fieldtwin new {folder / 'site'} writes into a new folder in it",
        )


def write_site(folder: Path, files: Mapping[str, str]) -> None:
    """Write every file of `files`, by its path in the folder. Raises `UsageError` if one cannot be written.

    After an error or an interruption, no file and no folder of the new site is left.
    """
    check_empty(folder)
    made: list[Path] = []
    try:
        for name, text in files.items():
            path = folder / name
            for parent in [*reversed(path.parents)]:
                if not parent.exists():
                    # the folder is noted before it is created, so that it is also removed after an interruption
                    made.append(parent)
                    parent.mkdir()
            made.append(path)
            path.write_bytes(text.encode("utf-8", "surrogateescape"))
    except BaseException as e:
        _remove(made)
        if isinstance(e, OSError):
            raise UsageError(f"cannot write {e.filename or folder}: {e.strerror or e}") from e
        raise


def _remove(made: list[Path]) -> None:
    for path in reversed(made):
        try:
            path.rmdir() if path.is_dir() else path.unlink(missing_ok=True)
        except OSError:
            continue  # a file that cannot be removed stays, and the first error is reported
