"""The ledgers of campaigns in the working directory and the folders in it, with the state of each campaign as its ledger grows.

A page names a ledger only by a name of this list, so it cannot make the server read any other file.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any

import msgspec

from fieldtwin.gateway.core.clock import NS_PER_S, Clock
from fieldtwin.gateway.core.errors import FieldtwinError, FileInvalid, UsageError
from fieldtwin.gateway.core.files.input_file import open_input, reading
from fieldtwin.reports.campaign.model import CampaignResult
from fieldtwin.reports.campaign.workers import timeline_of, workers_of
from fieldtwin.run.campaigns.ledger import LedgerEntry
from fieldtwin.run.campaigns.merging import by_fingerprint, merged
from fieldtwin.run.campaigns.reporting import campaign_of

MOST_LISTED = 20
"""Largest number of ledgers that are listed, the latest first."""
MOST_FOLDERS = 200
MOST_BYTES = 32 << 20
"""Size in bytes up to which a ledger is shown: that of about 15,000 runs with random faults."""
MOST_CAUSES = 5
QUIET_S = 60.0
"""Time in seconds after its last run until which a campaign counts as running, at least three times its longest run."""
_BEGIN = b'{"what":"'


class NoLedger(UsageError):
    """Raised when Studio knows no ledger of this name."""


@dataclass
class _Reading:
    """The entries of a ledger up to `offset`, in bytes. Only lines after it are read when the file has grown."""

    inode: int = 0
    offset: int = 0
    entries: list[LedgerEntry] = field(default_factory=list)
    campaigns: list[CampaignResult] = field(default_factory=list)

    def update(self, path: Path) -> None:
        """Read what was appended. Raises `FileInvalid`."""
        with reading(path), open_input(path) as file:
            stat = os.fstat(file.fileno())
            if stat.st_size > MOST_BYTES:
                raise FileInvalid(
                    "too large to be shown",
                    path=str(path),
                    expected=f"at most {MOST_BYTES} bytes",
                    got=f"{stat.st_size}",
                )
            if (stat.st_ino, stat.st_size) == (self.inode, self.offset):
                return
            if stat.st_ino != self.inode or stat.st_size < self.offset:
                self.inode, self.offset, self.entries = stat.st_ino, 0, []
            file.seek(self.offset)
            whole, newline, _ = file.read(MOST_BYTES).rpartition(b"\n")  # the last line may be incomplete
        try:
            self.entries += [msgspec.json.decode(line, type=LedgerEntry) for line in whole.split(b"\n") if line]
        except msgspec.DecodeError as e:
            raise FileInvalid(f"not a line of a ledger: {e}", path=str(path)) from e
        self.offset += len(whole) + len(newline)
        self.campaigns = self.results(path, with_coverage=False)

    def results(self, path: Path, *, with_coverage: bool) -> list[CampaignResult]:
        """Return the campaigns. Raises `FileInvalid` for an invalid coverage."""
        every = by_fingerprint(merged([self.entries]))
        return [campaign_of(runs, ledgers=[path.name], with_coverage=with_coverage) for runs in every]


class Ledgers:
    """The ledgers in `folder`. `clock` says whether a campaign still runs. Any thread may call the methods."""

    def __init__(self, folder: Path, clock: Clock) -> None:
        self._folder = folder
        self._clock = clock
        self._read: dict[Path, _Reading] = {}
        self._lock = threading.Lock()

    def states(self) -> list[dict[str, Any]]:
        """Return the state of each known ledger, the one that changed last first."""
        with self._lock:
            paths = self._paths()
            self._read = {path: known for path, known in self._read.items() if path in paths}
            return [self._state(path) for path in paths]

    def named(self, name: str) -> list[CampaignResult]:
        """Return the campaigns of a known ledger. Raises `NoLedger`, and `FileInvalid` if it cannot be read."""
        with self._lock:
            path = next((path for path in self._paths() if self._name(path) == name), None)
            if path is None:
                raise NoLedger(
                    f"no ledger {name[:80]!r} is known",
                    hint="put it into Studio's working directory, or a folder in it",
                )
            return self._updated(path).results(path, with_coverage=True)

    def _paths(self) -> list[Path]:
        subfolders = [path for path in self._folder.iterdir() if path.is_dir() and not path.name.startswith(".")]
        folders = [self._folder, *sorted(subfolders)[:MOST_FOLDERS]]
        found = [path for folder in folders for path in folder.glob("*.jsonl")]
        return list(islice(filter(_is_ledger, sorted(found, key=_changed_ns, reverse=True)), MOST_LISTED))

    def _updated(self, path: Path) -> _Reading:
        known = self._read.setdefault(path, _Reading())
        try:
            known.update(path)
        except FieldtwinError:
            del self._read[path]
            raise
        return known

    def _state(self, path: Path) -> dict[str, Any]:
        name = self._name(path)
        try:
            campaigns = self._updated(path).campaigns
        except FieldtwinError as e:
            return {"name": name, "path": str(path), "trouble": str(e), "campaigns": []}
        now_s = self._clock.utc_ns() / NS_PER_S
        return {
            "name": name,
            "path": str(path),
            "trouble": "",
            "campaigns": [_described(campaign, now_s) for campaign in campaigns],
        }

    def _name(self, path: Path) -> str:
        return str(path.relative_to(self._folder)).replace("/", "~")


def _described(campaign: CampaignResult, now_s: float) -> dict[str, Any]:
    timeline = timeline_of(campaign.runs)
    wall_s = timeline.end_s - timeline.start_s if timeline is not None else 0.0
    timed_h = sum(run.hours for run in campaign.runs if run.ended_s)
    longest_s = max((run.took_s for run in campaign.runs), default=0.0)
    return {
        "title": campaign.title,
        "what": campaign.what,
        "version": campaign.version,
        "verdict": campaign.verdict.value,
        "running": timeline is not None and now_s - timeline.end_s < max(QUIET_S, 3 * longest_s),
        "runs": len(campaign.runs),
        "failed": len(campaign.failed),
        "hours": campaign.hours,
        "hours_per_hour": timed_h / wall_s * 3600 if wall_s else None,
        "workers": len(workers_of(campaign.runs)),
        "passed_over_time": timeline.passed if timeline is not None else [],
        "failed_over_time": timeline.failed if timeline is not None else [],
        "wall_s": wall_s,
        "causes": _causes(campaign),
        "more_causes": max(len(campaign.groups) - MOST_CAUSES, 0),
    }


def _causes(campaign: CampaignResult) -> Sequence[dict[str, Any]]:
    return [
        {
            "cause": group.cause[:500],
            "runs": len(group.runs),
            "seed": group.runs[0].seed,
            "reproduce": group.runs[0].reproduce,
        }
        for group in campaign.groups[:MOST_CAUSES]
    ]


def _is_ledger(path: Path) -> bool:
    try:
        with open_input(path) as file:
            return file.read(len(_BEGIN)) == _BEGIN
    except (OSError, FieldtwinError):
        return False


def _changed_ns(path: Path) -> int:
    try:
        return path.stat().st_mtime_ns
    except OSError:
        return 0
