"""A description of a run in its run directory, for programs that look at the run from outside, such as Studio.

The run writes the file when it starts and leaves it there, so that a finished run can still be examined.
"""

from __future__ import annotations

import os
from pathlib import Path

import msgspec

from fieldtwin.__about__ import __version__
from fieldtwin.gateway.core.errors import FileInvalid

FILE = "run.json"
SYSTEM_FILE = "system.pickle"
"""The system as the run has read it (`fieldtwin.twin.site.resolved`)."""
MOST_BYTES = 1 << 20


class RunRecord(msgspec.Struct, frozen=True, kw_only=True):
    """The description of a run. Times of frames and values count on the monotonic clock of the computer."""

    version: str = __version__
    system: str
    path: str
    """The system file."""
    prototype: bool
    allow_writes: bool
    """Whether the run may write to its devices, which is always true in a prototype."""
    started_utc_ns: int
    started_ns: int
    """The start of the run on the monotonic clock."""
    pid: int
    capture: str = ""
    """The file with the traffic of all buses (`--capture`), empty if it is not recorded."""
    field_elsewhere: bool = False
    """Whether the simulated devices run on another host (`--field`)."""
    writes_only_simulated: bool = False
    """Whether no real device can be written: it is a prototype, and real devices in it are read only."""


def write_record(run_dir: Path, record: RunRecord) -> None:
    """Write the record of a run; it replaces the one of an earlier run."""
    temporary = run_dir / f"{FILE}.new"
    temporary.write_bytes(msgspec.json.format(msgspec.json.encode(record), indent=2))
    temporary.chmod(0o600)
    os.replace(temporary, run_dir / FILE)


def read_record(run_dir: Path) -> RunRecord | None:
    """Return the record of the latest run in a run directory, or None if no run has written one.

    Raises `FileInvalid` if the file belongs to another version of fieldtwin or is damaged.
    """
    path = run_dir / FILE
    try:
        with path.open("rb") as file:
            content = file.read(MOST_BYTES)
    except FileNotFoundError:
        return None
    except OSError as e:
        raise FileInvalid(f"cannot be read: {e.strerror or e}", path=str(path)) from e
    try:
        record = msgspec.json.decode(content, type=RunRecord)
    except msgspec.MsgspecError as e:
        raise FileInvalid(f"not the record of a run: {e}", path=str(path)) from e
    if record.version != __version__:
        raise FileInvalid(
            "the run belongs to another version of fieldtwin", path=str(path), expected=__version__, got=record.version
        )
    return record
