"""What is asked of a prototype before a command is sent: the question, and the one who asks it. Pure.

How a prototype is forked and run ahead is unknown here: a twin is given somebody who can.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from fieldtwin.gateway.core.values import COMMAND


@dataclass(frozen=True, slots=True)
class Question:
    """What must hold in a prototype that is given the command and runs `horizon_s` seconds ahead: each of `require` from
    `settle_s` on all the time, each of `finally_` at the end. Expressions as in scenarios."""

    horizon_s: float
    require: tuple[str, ...] = ()
    finally_: tuple[str, ...] = ()
    settle_s: float = 5.0


@dataclass(frozen=True, slots=True)
class PlannedCommand(COMMAND):
    """A command for which the planner says what is to be asked first: a question of its own, or nothing (None).

    Of a plain COMMAND what is asked is the twin's to say.
    """

    question: Question | None = None


class WhatIf(Protocol):
    """Asks a prototype what comes of a command. One question at a time; the answer is looked for, never waited for."""

    def ask(self, command: COMMAND, question: Question) -> None:
        """Begin to ask."""
        ...

    def answer(self) -> str | None:
        """None: there is none yet. Empty: nothing speaks against the command. Else why it is not to be sent."""
        ...
