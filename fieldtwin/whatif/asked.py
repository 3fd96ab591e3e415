"""The process that is asked: ``python -m fieldtwin.whatif.asked``, one JSON object in, one out.

In, as `Asked`: a system, what is known of it, a command and what must hold. Out: ``{"objection": TEXT}``, empty when nothing
speaks against the command. With ``"only_check": true`` nothing is run; what is wrong with the question is the objection.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

import msgspec

from fieldtwin.gateway.core.errors import FieldtwinError
from fieldtwin.running.shore import Scripted
from fieldtwin.whatif.asking import Asked
from fieldtwin.whatif.fork import Fork, answer, check
from fieldtwin.whatif.outcome import Outcome
from fieldtwin.whatif.plan import Plan
from fieldtwin.whatif.state import KnownState

NICE = 5
"""Whoever runs beside it, a plant or its twin, goes first."""


def objection(asked: Asked) -> str:
    """What a prototype says of the command; empty when everything that is required holds."""
    fork = Fork(
        asked.system,
        KnownState(asked.values, asked.programs, source="the twin's knowledge"),
        asked.horizon_s,
        tuple(map(Path, asked.profiles)),
        Path(asked.prototype_file) if asked.prototype_file else None,
        settle_s=asked.settle_s,
    )
    plan = Plan("the command", (Scripted(0.0, asked.period_s),), (), asked.require, asked.finally_)
    try:
        if asked.only_check:
            check(fork, plan)
            return ""
        return told(answer(fork, plan))
    except FieldtwinError as e:
        return str(e)


def told(outcome: Outcome) -> str:
    """Why a plan is not to be followed: that its fork failed, or the first requirement that does not hold."""
    if outcome.error:
        return f"the prototype failed: {outcome.error}"
    for requirement in outcome.requirements:
        if requirement.broken_s is not None:
            when = "at the end" if requirement.kind == "finally" else "then"
            return (
                f"{requirement.text!r} does not hold {requirement.broken_s:.0f} s from now; {when} {requirement.seen}"
            )
    return ""


def main() -> int:
    if hasattr(os, "nice"):
        os.nice(NICE)
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what control logic prints is no answer
    asked = msgspec.json.decode(sys.stdin.buffer.read(), type=Asked)
    with answers:
        answers.write(msgspec.json.encode({"objection": objection(asked)}) + b"\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
