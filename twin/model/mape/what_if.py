"""The question that a twin asks a prototype before it sends a command, and the interface for asking it.

This module does not simulate the prototype; a twin is given an object that implements `WhatIf`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from fieldtwin.gateway.core.values import COMMAND


@dataclass(frozen=True, slots=True)
class Question:
    """The requirements on a prototype that receives the command and is then simulated for `horizon_s` seconds.

    Each expression of `require` must hold at all times from `settle_s` on, and each of `finally_` at the end. Expressions are
    written as in scenarios.
    """

    horizon_s: float
    require: tuple[str, ...] = ()
    finally_: tuple[str, ...] = ()
    settle_s: float = 5.0


@dataclass(frozen=True, slots=True)
class PlannedCommand(COMMAND):
    """A command for which the planner determines the question: its own question, or None to ask nothing.

    For a plain COMMAND the twin's default question applies.
    """

    question: Question | None = None


class WhatIf(Protocol):
    """The interface that asks a prototype about the consequences of a command, one question at a time.

    The caller polls for the answer.
    """

    def ask(self, command: COMMAND, question: Question) -> None:
        """Start to simulate `command` in a prototype, to answer `question`."""
        ...

    def answer(self) -> str | None:
        """Return None if there is no answer yet, an empty text if there is no objection to the command, else the objection."""
        ...
