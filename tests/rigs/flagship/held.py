"""A run of the flagship and its conversations, for the tests that examine it."""

from __future__ import annotations

from dataclasses import dataclass

from conversation import Conversation, canopen_conversation, rtu_conversation, tcp_conversation
from flagship import Run


@dataclass
class Held:
    """A run and its conversations by device."""

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
