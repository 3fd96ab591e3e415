"""The plan by which a poll group is read: with the fewest transactions, and without the gaps that the device was found to have.

Neighbouring registers are read together, over gaps up to a profile's `max_gap`. A device that refuses such a read with exception
02 (address) or 03 (too many) has a gap in it or a smaller limit. The read is then halved until each part is accepted or is a
single value. The gaps that this proves are kept and offered for the profile (case 25 of the test-case list). A gap is proved when
the device accepts the reads on both sides of it, but refuses one read that covers both. A value or a message is never split over
two transactions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

from fieldtwin.gateway.core.files.profile import DeviceProfile, MessageBlock, RegisterRange, Tag
from fieldtwin.gateway.protocols.modbus.requests.data import ReadBits, ReadRegisters
from fieldtwin.gateway.protocols.modbus.requests.replies import BitsReply, RegistersReply
from fieldtwin.gateway.protocols.modbus.requests.request import Request

ILLEGAL_ADDRESS, TOO_LONG = 0x02, 0x03
"""The exception codes (AP 7) which show that a read covered a gap, or that it was too long."""

Member = tuple[RegisterRange, Tag | MessageBlock]


@dataclass(frozen=True)
class Read:
    """One transaction of a poll group."""

    range: RegisterRange
    tags: tuple[Tag, ...]
    messages: tuple[MessageBlock, ...]

    @cached_property
    def request(self) -> Request[BitsReply | RegistersReply]:
        """Return the request, which is checked once for all polls."""
        return read_request(self.range)

    @cached_property
    def places(self) -> tuple[tuple[Tag, slice], ...]:
        """Return each tag, with the position of its bytes in the data that the device returns for this read."""
        return tuple((tag, place_of(tag.registers, self.range)) for tag in self.tags)

    @property
    def members(self) -> list[Member]:
        """Return the tags and messages that are read, sorted by address.

        If two begin at one address, the longer one comes first.
        """
        both: list[Member] = [(t.registers, t) for t in self.tags]
        both += [(m.at, m) for m in self.messages]
        return sorted(both, key=lambda m: (m[0].address, -m[0].count))


def read_request(at: RegisterRange) -> Request[BitsReply | RegistersReply]:
    """Return the request that reads the range `at`."""
    if at.table == "coil" or at.table == "discrete":
        return ReadBits(at.table, at.address, at.count)
    return ReadRegisters(at.table, at.address, at.count)


def cells(reply: BitsReply | RegistersReply) -> bytes:
    """Return registers as the bytes that were received, and bits as one byte each."""
    return bytes(reply.bits) if isinstance(reply, BitsReply) else reply.raw


def place_of(at: RegisterRange, read: RegisterRange) -> slice:
    """Return the position of the bytes of `at` in the data of the read `read`: two bytes per register, one per bit."""
    width = 1 if read.table in ("coil", "discrete") else 2
    start = (at.address - read.address) * width
    return slice(start, start + at.count * width)


@dataclass
class Learnt:
    """The gaps and limits that a device's refusals have shown, for all its poll groups.

    `gaps` are ranges between two values that no read may cover. A gap of 0 registers is a border: a new read begins
    after it (the device accepts fewer registers per read than the profile states). `missing` are tags that the device
    refuses even when they are read alone. `changes` counts what was learnt or unlearnt.
    """

    gaps: list[RegisterRange] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)
    changes: int = 0

    def learn_gap(self, gap: RegisterRange) -> None:
        if gap not in self.gaps:
            self.gaps.append(gap)
            self.changes += 1

    def learn_missing(self, tags: Sequence[str]) -> None:
        new = [t for t in tags if t not in self.missing]
        self.missing += new
        self.changes += bool(new)

    def found(self, tags: Sequence[str]) -> bool:
        """Record that the device returned these tags; return True if at least one of them was missing before."""
        back = [t for t in tags if t in self.missing]
        self.missing = [t for t in self.missing if t not in back]
        self.changes += bool(back)
        return bool(back)

    @property
    def profile_gaps(self) -> tuple[RegisterRange, ...]:
        """Return the gaps that a profile can list in `gaps`, sorted by address, without borders (gaps of 0 registers)."""
        return tuple(sorted((g for g in self.gaps if g.count), key=lambda g: (g.table, g.address)))


def plan_reads(profile: DeviceProfile, group: str, learnt: Learnt | None = None) -> tuple[Read, ...]:
    """Return the fewest transactions that read `group`, in address order.

    Gaps up to `max_gap` are read over. No transaction is longer than `read_registers`, and none covers a gap that the
    profile states or that was learnt; a missing tag is read alone. Messages are read with the tag that announces them.
    If a device only supports pairs of registers (`even_only`), only whole pairs are read.
    """
    members: list[Member] = [(t.registers, t) for t in profile.group(group)]
    members += [(m.at, m) for m in profile.messages.values() if profile.tags[m.when].poll == group]
    members.sort(key=lambda m: (m[0].table, m[0].address, -m[0].count))
    avoid = list(profile.gaps)
    if learnt is not None:
        avoid += learnt.gaps
        avoid += [profile.tags[name].registers for name in learnt.missing if name in profile.tags]
    limits = profile.form.limits
    reads: list[tuple[RegisterRange, list[Member]]] = []
    for at, member in members:
        if reads:
            last, items = reads[-1]
            both = replace(last, count=max(last.end, at.end) - last.address)
            near = last.table == at.table and at.address - last.end <= limits.max_gap
            fits = _paired(profile, both).count <= limits.read_registers
            if near and (at.end <= last.end or (fits and not any(_crosses(both, gap) for gap in avoid))):
                reads[-1] = (both, [*items, (at, member)])
                continue
        reads.append((at, [(at, member)]))
    return tuple(_read(profile, items) for _, items in reads)


def _crosses(span: RegisterRange, gap: RegisterRange) -> bool:
    """Return whether `span` covers `gap`. It covers a border (a gap of 0 registers) if it has registers on both sides of it."""
    if span.table != gap.table:
        return False
    if not gap.count:
        return span.address < gap.address < span.end
    return span.address < gap.end and gap.address < span.end


def _paired(profile: DeviceProfile, at: RegisterRange) -> RegisterRange:
    """Return `at`, widened to whole pairs of registers if the device only supports pairs."""
    if not profile.form.limits.even_only or at.table in ("coil", "discrete"):
        return at
    first = at.address - at.address % 2
    return replace(at, address=first, count=at.end + at.end % 2 - first)


def _read(profile: DeviceProfile, members: Sequence[Member]) -> Read:
    first = members[0][0]
    span = replace(first, count=max(at.end for at, _ in members) - first.address)
    tags = tuple(i for _, i in members if isinstance(i, Tag))
    return Read(_paired(profile, span), tags, tuple(i for _, i in members if isinstance(i, MessageBlock)))


def split(profile: DeviceProfile, read: Read) -> tuple[Read, Read] | None:
    """Return the two parts of `read`, or None if it cannot be split.

    It is split as near to its middle as possible without cutting a value (or a pair, if the device only supports pairs)."""
    members = read.members
    borders: list[tuple[int, int]] = []
    end = _paired(profile, members[0][0]).end
    for i, (at, _) in enumerate(members[1:], 1):
        paired = _paired(profile, at)
        if paired.address >= end:
            borders.append((abs(2 * at.address - read.range.address - read.range.end), i))
        end = max(end, paired.end)
    if not borders:
        return None
    cut = min(borders)[1]
    return _read(profile, members[:cut]), _read(profile, members[cut:])


@dataclass
class _Split:
    """A refused read and its two parts.

    `taken` are the parts that the device accepted; if it accepted both, the gap is proved.
    """

    first: Read
    second: Read
    code: int
    taken: set[Read] = field(default_factory=set)


class GroupPlan:
    """The reads of a poll group, adapted to the device's refusals. All groups of a device share `learnt`."""

    def __init__(self, profile: DeviceProfile, group: str, learnt: Learnt | None = None) -> None:
        self.learnt = learnt if learnt is not None else Learnt()
        self._profile = profile
        self._group = group
        self._splits: dict[Read, _Split] = {}
        self._refused_any = self._found_any = False
        self.reads: list[Read] = []
        self.plan_again()

    def plan_again(self) -> None:
        """Make the plan again from the profile and from `learnt`. Tags that the device refused are requested again."""
        self.reads = list(plan_reads(self._profile, self._group, self.learnt))
        self._splits.clear()
        self._refused_any = self._found_any = False

    def refused(self, read: Read, code: int = ILLEGAL_ADDRESS) -> tuple[Read, ...]:
        """Return the reads that replace `read`, which the device refused with exception `code`.

        The result is empty when a single value is refused: it is left out of the plan.
        """
        self._refused_any = True
        parts = split(self._profile, read) or ()
        self.reads = [r for known in self.reads for r in (parts if known == read else (known,))]
        if not parts:
            self.learnt.learn_missing([t.name for t in read.tags])
            return ()
        self._splits |= dict.fromkeys(parts, _Split(*parts, code))
        return parts

    def taken(self, read: Read) -> None:
        """Record that the device answered `read`, which may prove a gap."""
        if self.learnt.missing:
            self._found_any |= self.learnt.found([t.name for t in read.tags])
        if not self._splits or (whole := self._splits.get(read)) is None:
            return
        whole.taken.add(read)
        first, second = whole.first, whole.second
        # if the device also refused a part, that alone explains why it refused the whole read
        if len(whole.taken) == 2:
            gap = second.range.address - first.range.end if whole.code == ILLEGAL_ADDRESS else 0
            self.learnt.learn_gap(RegisterRange(first.range.table, first.range.end, gap))
            del self._splits[first], self._splits[second]

    def pass_ended(self) -> None:
        """End one pass over the poll group, in which the device answered or refused every read.

        If it refused a read, halves that need not be separate are joined again, and missing tags are left out. If no read is
        left, one value is still requested: when the device has that value again, it may also have the missing ones.
        """
        if self._found_any:
            self.plan_again()
        elif self._refused_any or not self.reads:
            missing = set(self.learnt.missing)
            self.plan_again()
            planned = self.reads
            self.reads = [r for r in planned if not r.tags or not missing.issuperset(t.name for t in r.tags)]
            self.reads = self.reads or planned[:1]
