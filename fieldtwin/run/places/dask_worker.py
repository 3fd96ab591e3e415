"""The part of a campaign that runs in the workers of a Dask cluster.

A plugin brings the campaign to each worker once, also to workers that are added later. Its units are then small.
"""

from __future__ import annotations

import pickle
import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path
from threading import Lock
from typing import Any

from distributed import Worker, WorkerPlugin, get_worker

from fieldtwin.run.places.bundle import Bundle, unpack
from fieldtwin.run.places.environment import Environment, check_environment, check_shipped
from fieldtwin.run.places.unit_processes import UnitLost, UnitProcesses


@dataclass(frozen=True, slots=True)
class CampaignParcel:
    """Everything that a worker needs: the files, the pickled work, the software that it needs, and the time limit of a unit in
    seconds.
    """

    files: Bundle
    work: bytes
    environment: Environment
    limit_s: float


@dataclass(frozen=True, slots=True)
class Answer:
    """The answer of a worker about a unit: the pickled result or error, or None with the reason why the unit was lost."""

    worker: str
    address: str
    data: bytes | None
    lost: str = ""


class CampaignPlugin(WorkerPlugin):  # type: ignore[misc]  # distributed has no types
    """A campaign on a worker. Its files and its processes exist from the first unit until the campaign ends."""

    def __init__(self, name: str, parcel: CampaignParcel) -> None:
        self.name = name
        self._parcel = parcel

    def setup(self, worker: Worker) -> None:
        self._worker, self._lock = worker, Lock()
        self._folder: Path | None = None
        self._processes: UnitProcesses | None = None

    def teardown(self, worker: Worker) -> None:
        with self._lock:
            if self._processes is not None:
                self._processes.close()
            if self._folder is not None:
                shutil.rmtree(self._folder, ignore_errors=True)

    def run(self, unit: Any) -> Answer:
        """Run a unit. Raises `NotReproducible` if this worker's software differs from the software of the campaign."""
        name, address = str(self._worker.name), str(self._worker.address)
        try:
            return Answer(name, address, self._ready(name).run(pickle.dumps(unit)))
        except UnitLost as e:
            return Answer(name, address, None, str(e))

    def _ready(self, worker: str) -> UnitProcesses:
        """Return the processes. The first call checks the software and writes the files."""
        with self._lock:
            if self._processes is None:
                parcel = self._parcel
                check_environment(parcel.environment, worker)
                check_shipped(parcel.files.shipped, worker)
                self._folder = Path(tempfile.mkdtemp(prefix="fieldtwin-", dir=self._worker.local_directory))
                cwd = unpack(parcel.files, self._folder)
                # the folders that this variable names on the user's computer are part of the work
                self._processes = UnitProcesses(parcel.work, cwd, parcel.limit_s, without=("FIELDTWIN_PROFILES",))
            return self._processes


def run_unit(campaign: str, unit: Any) -> Answer:
    """Run a unit of the campaign whose plugin has this name."""
    plugin = get_worker().plugins[campaign]
    assert isinstance(plugin, CampaignPlugin)
    return plugin.run(unit)
