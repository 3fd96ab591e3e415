"""A run of the flagship and what was said in it, for the tests that look at it."""

from __future__ import annotations

from dataclasses import dataclass

from conversation import Conversation, canopen_conversation, rtu_conversation, tcp_conversation
from flagship import Run


@dataclass
class Held:
    """A run and what was said in it, by device."""

    run: Run
    talks: dict[str, Conversation]

    @classmethod
    def of(cls, run: Run) -> Held:
        return cls(
            run,
            {
                "ctd": rtu_conversation("ctd", run.of_bus("line1")),
                "modem": tcp_conversation("modem", run.of_bus("lan")),
                "inclinometer": canopen_conversation("inclinometer", run.of_bus("can0"), 5),
            },
        )
