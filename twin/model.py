"""The digital model: one state machine, and nothing that could reach the physical twin.

Every twin has an instance of its own: the prototype's, the shadow's, and the one by which a run judges what its control logic
did. It may know no wire, no clock and no store.
"""

from __future__ import annotations

from gateway.core.statemachine import STATE, EventStateMachine
from gateway.core.values import COMMAND


class DigitalModel:
    """SPEC row DigitalModel. Init: STANDBY, period 0. ProcessEvent is the state machine's."""

    __slots__ = ("state_machine",)

    def __init__(self) -> None:
        self.state_machine = EventStateMachine()

    @property
    def state(self) -> STATE:
        return self.state_machine.state

    @property
    def period_s(self) -> int:
        """The period in seconds as last commanded, also when it is 0 or negative."""
        return self.state_machine.period_s

    def process_event(self, command: COMMAND) -> STATE:
        """Take a command; the new state. Raises `Desync` for one that is none, which changes nothing."""
        return self.state_machine.process_event(command)
