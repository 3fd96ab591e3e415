"""The process that simulates one command for a digital twin: ``python -m fieldtwin.run.what_if.asked``. JSON in, JSON out.

Input on stdin, as `QuestionMessage`: a system, its known state, a command and the requirements. Output on stdout:
``{"objection": TEXT}``, empty if the prototype does not object to the command. With ``"only_check": true``
nothing is run, and the objection is an error in the question.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

import msgspec

from fieldtwin.gateway.core.errors import FieldtwinError
from fieldtwin.run.processes.topside import Scripted
from fieldtwin.run.what_if.asking import QuestionMessage
from fieldtwin.run.what_if.fork import Fork, answer, check
from fieldtwin.run.what_if.outcome import PlanOutcome
from fieldtwin.run.what_if.plan import WhatIfPlan
from fieldtwin.run.what_if.state import KnownState

NICE = 5
"""Niceness of the process: a plant or twin on the same computer has priority."""


def objection(asked: QuestionMessage) -> str:
    """Return the prototype's objection to the command; empty if all requirements hold."""
    fork = Fork(
        asked.system,
        KnownState(asked.values, asked.programs, source="the twin's knowledge"),
        asked.horizon_s,
        tuple(map(Path, asked.profiles)),
        Path(asked.prototype_file) if asked.prototype_file else None,
        settle_s=asked.settle_s,
    )
    plan = WhatIfPlan("the command", (Scripted(0.0, asked.period_s),), (), asked.require, asked.finally_)
    try:
        if asked.only_check:
            check(fork, plan)
            return ""
        return requirement_objection(answer(fork, plan))
    except FieldtwinError as e:
        return str(e)


def requirement_objection(outcome: PlanOutcome) -> str:
    """Return why a plan must not be executed: the failure of its fork, or the first requirement that does not hold."""
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
    os.dup2(2, 1)  # the output of control logic must not be mixed with the answer
    asked = msgspec.json.decode(sys.stdin.buffer.read(), type=QuestionMessage)
    with answers:
        answers.write(msgspec.json.encode({"objection": objection(asked)}) + b"\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
