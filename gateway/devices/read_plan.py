"""How a poll group is read: the fewest transactions, and what a device taught about its holes.

Neighbouring registers are read together, over gaps up to a profile's `max_gap`. A device that refuses such a read with exception
02 (address) or 03 (too many) has a hole in it or a limit of its own: the read is halved until both sides are taken, the hole is
remembered and offered for the profile (catalogue case 25). A value or a message is never split over two transactions.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from gateway.core.profile import DeviceProfile, Message, RegisterRange, Tag


@dataclass(frozen=True)
class Read:
    """One transaction of a poll group."""

    range: RegisterRange
    tags: tuple[Tag, ...]
    messages: tuple[Message, ...]

    @property
    def members(self) -> list[tuple[RegisterRange, Tag | Message]]:
        """What is read, by address; the longer first where two start at one address."""
        both: list[tuple[RegisterRange, Tag | Message]] = [(t.registers, t) for t in self.tags]
        both += [(m.at, m) for m in self.messages]
        return sorted(both, key=lambda m: (m[0].address, -m[0].count))


def plan_reads(profile: DeviceProfile, group: str) -> tuple[Read, ...]:
    """The fewest transactions that read `group`, in address order: gaps up to `max_gap` are read over, none is longer
    than `read_registers`. Messages come along with the tag that announces them."""
    limits = profile.form.limits
    members: list[tuple[RegisterRange, Tag | Message]] = [(t.registers, t) for t in profile.group(group)]
    members += [(m.at, m) for m in profile.messages.values() if profile.tags[m.when].poll == group]
    members.sort(key=lambda m: (m[0].table, m[0].address, -m[0].count))
    reads: list[tuple[RegisterRange, list[Tag | Message]]] = []
    for at, member in members:
        if reads:
            last, items = reads[-1]
            end = max(last.end, at.end)
            fits = end - last.address <= limits.read_registers and at.address - last.end <= limits.max_gap
            if last.table == at.table and fits:
                reads[-1] = (replace(last, count=end - last.address), [*items, member])
                continue
        reads.append((at, [member]))
    return tuple(_read(at, items) for at, items in reads)


def _read(at: RegisterRange, items: list[Tag | Message]) -> Read:
    tags = tuple(i for i in items if isinstance(i, Tag))
    return Read(at, tags, tuple(i for i in items if isinstance(i, Message)))


def split(read: Read) -> tuple[Read, Read] | None:
    """`read` in two, at the border nearest to its middle that cuts no value; None where there is no such border."""
    members = read.members
    borders: list[tuple[int, int]] = []
    end = members[0][0].end
    for i, (at, _) in enumerate(members[1:], 1):
        if at.address >= end:
            borders.append((abs(2 * at.address - read.range.address - read.range.end), i))
        end = max(end, at.end)
    if not borders:
        return None
    cut = min(borders)[1]
    return _joined(members[:cut]), _joined(members[cut:])


def _joined(members: list[tuple[RegisterRange, Tag | Message]]) -> Read:
    first = members[0][0]
    end = max(at.end for at, _ in members)
    return _read(replace(first, count=end - first.address), [item for _, item in members])


class GroupPlan:
    """A poll group's reads, as planned and as learnt.

    `holes` are ranges between values that the device refuses to be read over; `missing` are tags that it refuses by
    themselves. Both are for the profile's author to see.
    """

    def __init__(self, profile: DeviceProfile, group: str) -> None:
        self.reads = list(plan_reads(profile, group))
        self.holes: list[RegisterRange] = []
        self.missing: list[str] = []

    def refused(self, read: Read) -> tuple[Read, ...]:
        """The device refused `read`: what to read instead, from now on. Empty when a single value is refused."""
        parts = split(read)
        place = self.reads.index(read)
        if parts is None:
            self.reads.pop(place)
            self.missing += [t.name for t in read.tags]
            return ()
        self.reads[place : place + 1] = parts
        first, second = parts
        gap = second.range.address - first.range.end
        if gap:
            self.holes.append(RegisterRange(read.range.table, first.range.end, gap))
        return parts
