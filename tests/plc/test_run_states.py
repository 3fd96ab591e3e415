"""States shown by a run: those of each program's table; and the programs that are checked by the remote client's commands."""

from __future__ import annotations

from fieldtwin.gateway.core.image.image import message_tag
from fieldtwin.plc.binding import BoundProgram, InputBinding, image_for
from fieldtwin.plc.relay import Relay
from fieldtwin.plc.states import StateMachine, StateTable, Transition
from fieldtwin.run.processes.states import StateWatch, state_words
from fieldtwin.twin.site.system import load_system


class Gate(StateMachine):
    table = StateTable(Transition("SHUT", "OPEN", after_ms=50), Transition("OPEN", "SHUT", after_ms=50))


def test_states_are_named_by_the_programs_own_table() -> None:
    boxes = {name: message_tag(name, 64, 4) for name in ("m.in", "m.sample")}
    inputs = {"command": InputBinding("m.in"), "sample": InputBinding("m.sample")}
    layout = image_for([BoundProgram("relay", Relay(), inputs), BoundProgram("gate", Gate())], boxes)
    assert state_words(layout, ["relay", "gate", "none"]) == {
        "relay": {0: "STANDBY", 1: "ACTIVE", 2: "OFF"},
        "gate": {0: "SHUT", 1: "OPEN"},
    }
    watch = StateWatch(load_system("observatory"))
    watch.knows(layout)
    watch._words = state_words(layout, ["relay", "gate"])  # the observatory has no gate
    watch.note("relay", "STANDBY", 0)
    watch.note("gate", "OPEN", 0)
    assert watch.relays == ["relay"]  # a gate changes its state independent of commands
