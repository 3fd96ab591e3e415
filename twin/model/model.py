"""The digital model: one state machine, the variables that the system declares, and nothing that could reach the plant.

Every twin has an instance of its own: the prototype's, the shadow's, and the one by which a run judges what its control logic
did. It changes by events alone, and may know no wire, no clock and no store.
"""

from __future__ import annotations

from collections.abc import Iterable

from fieldtwin.gateway.core.statemachine import STATE, EventStateMachine
from fieldtwin.gateway.core.values import COMMAND
from fieldtwin.twin.model.variables import Variable, Variables


class DigitalModel:
    """SPEC row DigitalModel. Init: STANDBY, period 0, nothing known of any variable. ProcessEvent is the state machine's.

    `declared`: the system's variables (`fieldtwin.twin.plant.declared`). What is heard of them is `variables`; no command and no
    status changes that, and none of them changes the state.
    """

    __slots__ = ("state_machine", "variables")

    def __init__(self, declared: Iterable[Variable] = ()) -> None:
        self.state_machine = EventStateMachine()
        self.variables = Variables(declared)

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
