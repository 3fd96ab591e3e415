"""The writes that an agent may propose. This module must never carry one out: the user's own process does that."""

from __future__ import annotations

import asyncio
from collections.abc import Collection
from pathlib import Path
from typing import Any

from fieldtwin.agents.results import MOST_CHARACTERS
from fieldtwin.gateway.core.clock import Clock
from fieldtwin.gateway.core.errors import FieldtwinError, NotAllowed, UsageError
from fieldtwin.run.proposals.folder import ProposalFolder
from fieldtwin.run.proposals.judging import propose
from fieldtwin.run.proposals.proposal import Proposal

EXPIRE_EVERY_S = 1.0
LOOK_EVERY_S = 0.2
MOST_REMEMBERED = 1_000
"""Number of the agent's own proposals whose states it can ask for, the latest ones."""


class PlantWrites:
    """The proposals of one agent, for the running systems `allowed`. `audit` is the log that records the user's decisions."""

    def __init__(self, allowed: Collection[str], clock: Clock, by: str, audit: Path) -> None:
        self._allowed = frozenset(allowed)
        self._clock = clock
        self._by = by
        self._audit = audit.resolve()
        self._folder = ProposalFolder(clock)
        self._own: dict[int, Proposal] = {}

    async def propose(self, instance: str, tag: str, value: float, reason: str) -> Proposal:
        """Propose a write. Raises `NotAllowed` for an instance that the user has not enabled for it, and as `propose`."""
        if instance not in self._allowed:
            raise NotAllowed(
                f"this agent may not propose writes to the instance {instance[:60]!r}",
                expected=", ".join(sorted(self._allowed)) or "an instance that the user has enabled; none is",
                hint="the user enables it with: fieldtwin mcp --allow-proposals INSTANCE",
            )
        made = await propose(
            self._folder,
            self._clock,
            instance=instance,
            tag=tag,
            value=value,
            reason=reason,
            by=self._by,
            audit=str(self._audit),
        )
        self._own[made.number] = made
        while len(self._own) > MOST_REMEMBERED:
            del self._own[next(iter(self._own))]
        return made

    async def decision(self, number: int, seconds: float) -> dict[str, Any]:
        """Return the state of a proposal of this agent, once a user has decided or after some seconds."""
        proposal = self._of_agent(number)
        end_ns = self._clock.monotonic_ns() + int(seconds * 1e9)
        while True:
            self._folder.expire()
            ended = self._folder.ended(number)
            if ended is not None or self._clock.monotonic_ns() >= end_ns:
                state = self._folder.state(number)[:MOST_CHARACTERS]
                remaining_ns = max(0, proposal.expires_ns - self._clock.monotonic_ns())
                return {"proposal": number, "decided": ended is not None, "state": state} | (
                    {} if ended is not None else {"expires_in_s": remaining_ns // 10**9}
                )
            await asyncio.sleep(LOOK_EVERY_S)

    def withdraw(self, number: int) -> None:
        """Withdraw a proposal of this agent. Raises `NotAllowed` if it has been decided."""
        self._folder.refuse(self._of_agent(number), "withdrawn", self._by)

    async def expire(self) -> None:
        """End proposals whose time is over, again and again, so that the audit log records it soon."""
        while True:
            await asyncio.sleep(EXPIRE_EVERY_S)
            try:
                self._folder.expire()
            except FieldtwinError:
                continue  # the disk is full, for example; the next attempt, or the next user, records it

    def _of_agent(self, number: int) -> Proposal:
        if number not in self._own:
            own = ", ".join(map(str, list(self._own)[-10:])) or "none"
            raise UsageError(f"this agent has made no proposal {number}", expected=own)
        return self._own[number]
