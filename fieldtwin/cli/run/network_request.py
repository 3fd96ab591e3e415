"""The options of a network run."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from fieldtwin.run.virtual.fault_schedule import RandomFaults


class NetworkRequest(NamedTuple):
    """A run of the network in the file `path`. `commands` None: the default commands of the topside controller."""

    path: Path
    virtual: bool
    duration_s: float
    seed: int | None
    instance: str
    profiles: tuple[str, ...]
    commands: tuple[int, ...] | None
    trace: str | None
    cold: bool
    as_json: bool
    thread: str = ""
    faults: str = ""
    seeds: str = ""
    jobs: int = 1
    ledger: str | None = None
    trust: bool = False
    random_faults: RandomFaults | None = None
