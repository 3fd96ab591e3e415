"""Read the tags of a profile in the fewest requests that the limits of the profile and of the device allow.

The sweep is a generator without I/O, as in `sweep`. It uses the gateway's read planner
(`fieldtwin.gateway.devices.read_plan`): a refused read is halved, and limits learnt in one pass are used from the next pass
on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from fieldtwin.commissioning.access.point import asked_profile
from fieldtwin.commissioning.dump.coverage import joined
from fieldtwin.commissioning.dump.sweep import MOST_SILENT, Asking, Invalid, RefusedRead, Silent, TableMap, Taken
from fieldtwin.gateway.core.files.profile import DeviceProfile, RegisterRange, Tag
from fieldtwin.gateway.devices.read_plan import ILLEGAL_ADDRESS, TOO_LONG, GroupPlan


class ProfileSweep:
    """A sweep that reads `tags` of `profile`. `maps` are the findings by table.

    After `MOST_SILENT` consecutive reads without a reply, reads are not repeated any more. The sweep ends when the device has
    answered none of the first `MOST_SILENT` reads, or when reads without a result have taken `budget_us` microseconds.
    """

    def __init__(self, profile: DeviceProfile, tags: Sequence[Tag], budget_us: int | None = None) -> None:
        asked = asked_profile(tags, profile)
        self.plan = GroupPlan(replace(asked, gaps=(*asked.gaps, *_let_alone(profile, tags))), "asked")
        self.stopped = ""
        self.patient = True
        self.maps: dict[str, TableMap] = {}
        self._budget_us = budget_us

    def asking(self) -> Asking:
        todo, silent, spent_us, heard = list(self.plan.reads), 0, 0, False
        while todo and not self.stopped:
            read = todo.pop(0)
            self.patient = silent < MOST_SILENT
            outcome = yield read.range
            found = self.maps.setdefault(read.range.table, TableMap(read.range.table))
            if isinstance(outcome, Taken):
                self.plan.taken(read)
                found.readable = joined([*found.readable, (read.range.address, read.range.end)])
                found.max_read = max(found.max_read, read.range.count)
            elif isinstance(outcome, RefusedRead):
                found.codes[outcome.code] = found.codes.get(outcome.code, 0) + 1
            if isinstance(outcome, RefusedRead) and outcome.code in (ILLEGAL_ADDRESS, TOO_LONG):
                todo[:0] = self.plan.refused(read, outcome.code)
            # one of several registers may be the reason for the refusal
            elif isinstance(outcome, Silent | Invalid) and heard:
                todo[:0] = self.plan.refused(read)
            silent = silent + 1 if isinstance(outcome, Silent) else 0
            heard |= not isinstance(outcome, Silent)
            spent_us += outcome.us if isinstance(outcome, Silent | Invalid) else 0
            if silent >= MOST_SILENT and not heard:
                self.stopped = f"no reply {MOST_SILENT} times in a row"
            elif self._budget_us is not None and spent_us > self._budget_us:
                self.stopped = (
                    f"the time budget of {self._budget_us / 1e6:g} s for requests without a result is used up"
                )
        for table, found in self.maps.items():
            found.stopped = self.stopped if any(r.range.table == table for r in todo) else ""
        self.plan.pass_ended()

    def reads(self) -> list[RegisterRange]:
        """Return the reads of the next pass."""
        return [read.range for read in self.plan.reads]


def _let_alone(profile: DeviceProfile, tags: Sequence[Tag]) -> list[RegisterRange]:
    """Return the registers of the profile's other tags, so that a read over a gap between two of `tags` does not include them."""
    wanted = [t.registers for t in tags]
    others = [t.registers for t in profile.tags.values() if t.name not in {w.name for w in tags}]
    return [o for o in others if not any(w.overlaps(o) for w in wanted)]


def dumped_tags(profile: DeviceProfile) -> tuple[list[Tag], list[Tag]]:
    """Return the tags that a dump reads, and those that it omits: secrets, and tags whose reading has an effect."""
    touchy = {e.tag.name for e in profile.effects if e.on_read}
    readable = [t for t in profile.tags.values() if t.readable]
    wanted = [t for t in readable if not t.secret and t.name not in touchy]
    return wanted, [t for t in readable if t not in wanted]
