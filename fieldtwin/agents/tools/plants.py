"""Tools that propose a write to a running plant. None of them writes: a user confirms or refuses each proposal."""

from __future__ import annotations

from typing import Any

import msgspec

from fieldtwin.agents.tool import Tool
from fieldtwin.agents.tools.instances import check_wait
from fieldtwin.agents.workplace import Workplace
from fieldtwin.run.proposals.judging import as_text, number_text
from fieldtwin.run.proposals.proposal import EXPIRES_AFTER_S


class ProposeWrite(msgspec.Struct, forbid_unknown_fields=True):
    """A value in engineering units for a writable tag, and a reason of at most 200 characters, which the user reads."""

    instance: str
    tag: str
    value: float | bool
    reason: str


class OfProposal(msgspec.Struct, forbid_unknown_fields=True):
    """The number of a proposal, as propose_write returns it."""

    proposal: int


class Decision(msgspec.Struct, forbid_unknown_fields=True):
    """The number of a proposal, and the time for which to wait for the user."""

    proposal: int
    seconds: float = 0.0


async def propose_write(work: Workplace, given: ProposeWrite) -> dict[str, Any]:
    """Store a proposal, and return its number and what the user has to do."""
    made = await work.writes.propose(given.instance, given.tag, float(given.value), given.reason)
    return {
        "proposal": made.number,
        "write": f"{made.tag}: {as_text(made.seen)} → {number_text(made.value)} {made.unit}".rstrip(),
        "expires_in_s": EXPIRES_AFTER_S,
        "next": f"ask the user to decide in a terminal: fieldtwin approve {made.number}",
    }


async def get_proposal(work: Workplace, given: Decision) -> dict[str, Any]:
    """Return whether a user has decided, and the result of the write."""
    check_wait(given.seconds)
    return await work.writes.decision(given.proposal, given.seconds)


async def withdraw_proposal(work: Workplace, given: OfProposal) -> dict[str, Any]:
    """Withdraw a proposal that waits."""
    work.writes.withdraw(given.proposal)
    return {"withdrawn": given.proposal}


PROPOSAL = "proposal"
TOOLS = (
    Tool(
        "propose_write",
        "Propose a write to a running plant. Nothing is written unless the user confirms it.",
        propose_write,
        ProposeWrite,
        PROPOSAL,
    ),
    Tool(
        "get_proposal",
        "Read what the user has decided about a proposed write, or wait at most 30 s.",
        get_proposal,
        Decision,
    ),
    Tool("withdraw_proposal", "Withdraw a proposal that you have made.", withdraw_proposal, OfProposal, PROPOSAL),
)
