"""The digital model: the system's state machine in a virtual environment (SPEC rows DigitalModel, EventStateMachine).

Driven by events only. It has no connection to the physical twin, and every twin holds an instance of its own.
"""

from __future__ import annotations

from gateway.core.statemachine import STATE, EventStateMachine
from gateway.core.values import COMMAND


class DigitalModel:
    """Contains one state machine; ProcessEvent delegates to it."""

    def __init__(self) -> None:
        self.state_machine = EventStateMachine()

    @property
    def state(self) -> STATE:
        return self.state_machine.state

    @property
    def period_s(self) -> int:
        return self.state_machine.period_s

    def process_event(self, event: COMMAND) -> STATE:
        """ProcessEvent = stateMachine.ProcessEvent."""
        return self.state_machine.process_event(event)
