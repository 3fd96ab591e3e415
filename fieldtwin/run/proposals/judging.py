"""Judge a proposed write, and carry it out after a user has confirmed it. The gateway of the plant decides by its own rules."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import Any

from fieldtwin.gateway.core.clock import NS_PER_S, Clock
from fieldtwin.gateway.core.errors import CheckFailed, FieldtwinError, NotAllowed, Unreachable, UsageError
from fieldtwin.gateway.core.escaping import escape_controls
from fieldtwin.gateway.core.files.nearest import did_you_mean
from fieldtwin.gateway.core.files.profile import Tag
from fieldtwin.gateway.devices.codec import encode
from fieldtwin.run.processes.run_record import SYSTEM_FILE, RunRecord, read_record
from fieldtwin.run.proposals.folder import ProposalFolder
from fieldtwin.run.proposals.proposal import EXPIRES_AFTER_S, LONGEST_REASON, Ended, Proposal, Seen
from fieldtwin.twin.plant.channel import Channel
from fieldtwin.twin.plant.instance import Instance
from fieldtwin.twin.site.resolved import read_resolved
from fieldtwin.twin.site.system import System

WRITE_WITHIN_S = 8.0
"""Time limit of a write in seconds, which is longer than the gateway itself waits for the device."""


@dataclass(frozen=True)
class Plant:
    """A running instance: the record of its run, its system, and the control channel of its gateway."""

    name: str
    record: RunRecord
    system: System
    gateway: Channel

    def tag(self, name: str) -> Tag:
        """Return the tag DEVICE.TAG. Raises `UsageError`."""
        tags = {f"{d.name}.{t.name}": t for d in self.system.devices.values() for t in d.profile.tags.values()}
        if name not in tags:
            raise UsageError(f"no tag {name[:80]!r}", expected="DEVICE.TAG", hint=did_you_mean(name, list(tags)))
        return tags[name]

    async def judge(self, name: str, value: float) -> Seen:
        """Return the present value of a tag, if `value` may be written to it now.

        Raises `NotAllowed` for a plant that is read-only, a tag that no client may write, a secret tag, and a value outside its
        limits; and the errors of the gateway's control channel.
        """
        tag = self.tag(name)
        if tag.secret:
            raise NotAllowed(f"{name} is secret, so no agent may propose a value for it")
        if not self.record.allow_writes:
            raise NotAllowed(f"the instance {self.name} is read-only", hint="a user starts it with --allow-writes")
        writable: list[str] = await self.gateway.call("client_tags")
        if name not in writable:
            raise NotAllowed(
                f"no client may write {name}",
                expected=", ".join(writable[:20]) or "a tag that is `writable` and that no program commands",
            )
        encode(tag, value)
        answer: dict[str, Any] = await self.gateway.call("watch", names=[name], since=None)
        present, quality, reason, _ = answer["tags"][name]
        return Seen(present, quality, reason)


@asynccontextmanager
async def running_plant(instance: str) -> AsyncIterator[Plant]:
    """Yield a running instance. Raises `UsageError` if its name is invalid or it has never run, `Unreachable` if it has ended."""
    folder = Instance(instance).dir
    record = read_record(folder)
    if record is None:
        raise UsageError(f"no instance {instance[:60]!r} on this computer")
    [system] = read_resolved(str(folder / SYSTEM_FILE))
    assert isinstance(system, System)
    channel = Channel(folder / "gateway.sock", "gateway")
    try:
        yield Plant(instance, record, system, channel)
    finally:
        await channel.aclose()


async def propose(
    folder: ProposalFolder, clock: Clock, *, instance: str, tag: str, value: float, reason: str, by: str, audit: str
) -> Proposal:
    """Store the proposal of a write, if the plant would accept it now. Nothing is written. Raises as `Plant.judge`."""
    if len(reason) > LONGEST_REASON:
        raise UsageError("the reason is too long", expected=f"at most {LONGEST_REASON} characters")
    async with running_plant(instance) as plant:
        seen = await plant.judge(tag, value)
        now_ns = clock.monotonic_ns()
        proposal = Proposal(
            number=0,
            by=by,
            reason=escape_controls(" ".join(reason.split())),
            instance=instance,
            tag=tag,
            value=value,
            seen=seen,
            unit=plant.tag(tag).unit,
            run_pid=plant.record.pid,
            run_started_ns=plant.record.started_ns,
            asked_utc_ns=clock.utc_ns(),
            asked_ns=now_ns,
            expires_ns=now_ns + EXPIRES_AFTER_S * NS_PER_S,
            audit=audit,
        )
    return folder.add(proposal)


async def judge_again(proposal: Proposal) -> Seen:
    """Return the present value of the tag of a proposal. Raises as `Plant.judge`, and `CheckFailed` for another run."""
    async with running_plant(proposal.instance) as plant:
        return await _judged(plant, proposal)


async def confirm(folder: ProposalFolder, proposal: Proposal, shown: Seen, by: str) -> Ended:
    """Carry out a proposed write, if the tag still has the value that was `shown` to the user, and return its end.

    Raises `CheckFailed` if the value has changed or the plant was started again, `NotAllowed` if the proposal has been decided
    or has expired, and as `Plant.judge`. A write that the device or the gateway refuses ends the proposal as failed.
    """
    async with running_plant(proposal.instance) as plant:
        seen = await _judged(plant, proposal)
        if seen != shown:
            raise CheckFailed(
                f"{proposal.tag} has changed since it was shown",
                expected=as_text(shown),
                got=as_text(seen),
                hint="look again",
            )
        folder.take(proposal, by)
        audited = f"{by}, proposal {proposal.number} of {proposal.by}"
        try:
            await plant.gateway.call("write", WRITE_WITHIN_S, tag=proposal.tag, value=proposal.value, by=audited)
        except FieldtwinError as e:
            return folder.end(proposal, "failed", by, str(e))
        except BaseException:
            folder.end(proposal, "failed", by, "interrupted; the value may have been written")
            raise
        return folder.end(proposal, "written", by, f"{as_text(seen)} → {number_text(proposal.value)}")


async def _judged(plant: Plant, proposal: Proposal) -> Seen:
    if (plant.record.pid, plant.record.started_ns) != (proposal.run_pid, proposal.run_started_ns):
        raise CheckFailed(
            f"{proposal.instance} was started again after the proposal",
            hint=f"refuse it: fieldtwin approve {proposal.number} --refuse",
        )
    try:
        return await plant.judge(proposal.tag, proposal.value)
    except Unreachable as e:
        raise e.at(proposal.instance) from None


def as_text(seen: Seen) -> str:
    """Return a value with its quality for a message: ``20``, or ``20 (bad, timeout)``."""
    value = number_text(seen.value) if isinstance(seen.value, float) else str(seen.value)
    if seen.value is None:
        value = "no value"
    if seen.quality == "good":
        return value
    return f"{value} ({', '.join(filter(None, (seen.quality, seen.reason)))})"


def number_text(value: float) -> str:
    """Return a number with all of its digits, a whole one without a decimal point."""
    return str(int(value)) if float(value).is_integer() else repr(value)
