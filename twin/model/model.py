"""The digital model: one state machine and the variables that the system declares. It cannot reach the plant.

Each twin has its own instance: the prototype, the shadow, and each run that checks its control logic. Only events change it.
This module must not depend on a connection, a clock or a store.
"""

from __future__ import annotations

from collections.abc import Iterable

from fieldtwin.gateway.core.statemachine import STATE, EventStateMachine
from fieldtwin.gateway.core.values import COMMAND
from fieldtwin.twin.model.variables import ModelVariable, Variables


class DigitalModel:
    """The paper's DigitalModel. Init: STANDBY, period 0, all variables unknown. ProcessEvent is that of the state machine.

    `declared` holds the system's variables (`fieldtwin.twin.plant.declared`), and `variables` their last reported
    values. Commands and statuses do not change `variables`, and reported values do not change the state.
    """

    __slots__ = ("state_machine", "variables")

    def __init__(self, declared: Iterable[ModelVariable] = ()) -> None:
        self.state_machine = EventStateMachine()
        self.variables = Variables(declared)

    @property
    def state(self) -> STATE:
        return self.state_machine.state

    @property
    def period_s(self) -> int:
        """Return the last commanded period in seconds, even if it is 0 or negative."""
        return self.state_machine.period_s

    def process_event(self, command: COMMAND) -> STATE:
        """Apply a command and return the new state.

        Raises `Desync` if it cannot be decoded; the model then stays unchanged.
        """
        return self.state_machine.process_event(command)
