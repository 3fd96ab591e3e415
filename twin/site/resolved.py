"""The data of files that a run has read once, passed to the run's own processes.

Processes that read the same files themselves could see different versions of them. The data is passed as a pickle in the run
directory, which only its owner can read and write, and only processes of the same version read it.
"""

from __future__ import annotations

import os
import pickle
from pathlib import Path

from fieldtwin.gateway.core.errors import Bug


def write_resolved(path: Path, *files: object) -> str:
    """Write data that was read from files, such as a `System`, for a child process. Return the path as text.

    The file is readable and writable for its owner only, and replaces an older one.
    """
    temporary = path.with_suffix(".new")
    temporary.unlink(missing_ok=True)
    with open(os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
        pickle.dump(files, file)
    temporary.replace(path)
    return str(path)


def read_resolved(path: str) -> tuple[object, ...]:
    """Return the data that `write_resolved` wrote. Raises `Bug` if the file is not complete."""
    try:
        files = pickle.loads(Path(path).read_bytes())
    except (OSError, EOFError, pickle.UnpicklingError, AttributeError, ImportError) as e:
        raise Bug(f"cannot read the system that the run has written for its processes: {e}", where=path) from e
    assert isinstance(files, tuple)
    return files
