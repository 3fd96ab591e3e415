"""What a profile names, read in the fewest requests that its limits and the device's own allow.

A generator as `dump_sweep` is, over the planner that runs the plant (`gateway.devices.read_plan`): a refused read is halved, and
what is learnt on the way is used from the next pass on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from fieldtwin.commissioning.dump_sweep import MOST_SILENT, Asking, Refused, Silent, TableMap, Taken, joined
from fieldtwin.commissioning.point import asked_profile
from gateway.core.profile import DeviceProfile, RegisterRange, Tag
from gateway.devices.read_plan import ILLEGAL_ADDRESS, TOO_LONG, GroupPlan


class ProfileSweep:
    """Reads `tags` of `profile`. `maps` say what was found, by table; `learnt` what the device taught."""

    def __init__(self, profile: DeviceProfile, tags: Sequence[Tag]) -> None:
        asked = asked_profile(tags, profile)
        self.plan = GroupPlan(replace(asked, gaps=(*asked.gaps, *_let_alone(profile, tags))), "asked")
        self.given_up = ""
        self.maps: dict[str, TableMap] = {}

    def asking(self) -> Asking:
        todo, silent = list(self.plan.reads), 0
        while todo and not self.given_up:
            read = todo.pop(0)
            outcome = yield read.range
            found = self.maps.setdefault(read.range.table, TableMap(read.range.table))
            silent = silent + 1 if isinstance(outcome, Silent) else 0
            if silent >= MOST_SILENT:
                self.given_up = f"no reply {MOST_SILENT} times in a row"
            if isinstance(outcome, Taken):
                self.plan.taken(read)
                found.readable = joined([*found.readable, (read.range.address, read.range.end)])
                found.max_read = max(found.max_read, read.range.count)
            elif isinstance(outcome, Refused):
                found.codes[outcome.code] = found.codes.get(outcome.code, 0) + 1
                parts = self.plan.refused(read, outcome.code) if outcome.code in (ILLEGAL_ADDRESS, TOO_LONG) else ()
                todo[:0] = parts
                if not parts:
                    found.holes = joined([*found.holes, (read.range.address, read.range.end)])
        self.plan.pass_ended()

    def reads(self) -> list[RegisterRange]:
        """What the next pass reads."""
        return [read.range for read in self.plan.reads]


def _let_alone(profile: DeviceProfile, tags: Sequence[Tag]) -> list[RegisterRange]:
    """Where tags stand that are not asked for: a read over a gap between two others must not bring them along."""
    wanted = [t.registers for t in tags]
    others = [t.registers for t in profile.tags.values() if t.name not in {w.name for w in tags}]
    return [
        o for o in others if not any(w.table == o.table and w.address < o.end and o.address < w.end for w in wanted)
    ]


def dumped_tags(profile: DeviceProfile) -> tuple[list[Tag], list[Tag]]:
    """The tags that a dump reads, and those that it leaves alone: secrets, and what changes something when it is read."""
    touchy = {e.tag.name for e in profile.effects if e.on_read}
    readable = [t for t in profile.tags.values() if t.readable]
    wanted = [t for t in readable if not t.secret and t.name not in touchy]
    return wanted, [t for t in readable if t not in wanted]
