"""Schemas STATE, ACTIVE, STANDBY, OFF, EventStateMachine, DigitalModel."""

from __future__ import annotations

import dataclasses
import inspect
import json

import pytest
from hypothesis import given
from hypothesis import strategies as st
from spec_rig import CLOCK, observatory

from fieldtwin.gateway.core.errors import Desync
from fieldtwin.gateway.core.statemachine import (
    ACCEPTING,
    ACTIVE,
    OFF,
    STANDBY,
    STATE,
    STATES,
    EventStateMachine,
    encode_period,
)
from fieldtwin.gateway.core.values import COMMAND, Quality, Reason, Scalar
from fieldtwin.run.processes.states import expected_states
from fieldtwin.twin.model.model import DigitalModel
from fieldtwin.twin.model.variables import ModelVariable, Variables
from fieldtwin.twin.plant.declared import declared_variables
from fieldtwin.twin.prototype.prototype import DigitalTwinPrototype
from fieldtwin.twin.template.template import describe_model

PERIODS = st.integers(-32768, 32767)


def state_of(x: int) -> type[STATE]:
    """The row of the paper, written again: x > 0 ACTIVE, x = 0 STANDBY, x < 0 OFF."""
    return ACTIVE if x > 0 else STANDBY if x == 0 else OFF


def test_STATE_is_abstract_and_execute_is_overridden_by_each() -> None:
    assert inspect.isabstract(STATE)
    assert {type(state) for state in STATES.values()} == {ACTIVE, STANDBY, OFF}
    for state in STATES.values():
        assert "execute" in vars(type(state))


@given(period_s=st.integers(1, 32767))
def test_STATE_execute_samples_at_the_period_in_ACTIVE_and_never_otherwise(period_s: int) -> None:
    assert ACTIVE().execute(period_s) == period_s
    assert STANDBY().execute(period_s) == OFF().execute(period_s) == 0


def test_STATE_OFF_alone_is_accepting() -> None:
    """Ruling 6."""
    assert {"OFF"} == ACCEPTING


@pytest.mark.parametrize("kind", [EventStateMachine, DigitalModel])
def test_EventStateMachine_Init_is_STANDBY_and_period_0(kind: type[EventStateMachine] | type[DigitalModel]) -> None:
    """Ruling 6: Init also sets STANDBY. The model's Init is its machine's."""
    made = kind()
    assert type(made.state) is STANDBY
    assert made.period_s == 0


@given(before=st.lists(PERIODS, max_size=3), x=PERIODS | st.sampled_from([-1, 0, 1, -32768, 32767]))
def test_EventStateMachine_ProcessEvent_depends_on_the_sign_alone_from_every_state(before: list[int], x: int) -> None:
    """Ruling 6: total, OFF included, and it sets the period."""
    machine = EventStateMachine()
    for earlier in before:
        machine.process_event(encode_period(earlier))
    new = machine.process_event(encode_period(x))
    assert type(new) is type(machine.state) is state_of(x)
    assert machine.period_s == x


@given(bits=st.binary(max_size=5).filter(lambda b: len(b) != 2), x=PERIODS)
def test_EventStateMachine_data_that_is_not_a_command_changes_nothing(bits: bytes, x: int) -> None:
    machine = EventStateMachine()
    machine.process_event(encode_period(x))
    with pytest.raises(Desync):
        machine.process_event(COMMAND(bits))
    assert (machine.period_s, type(machine.state)) == (x, state_of(x))


def test_DigitalModel_contains_one_state_machine_and_the_declared_variables_and_nothing_else() -> None:
    """It has no connection to the physical twin: no attribute could hold one."""
    model = DigitalModel(declared_variables(observatory()[0]))
    assert DigitalModel.__slots__ == ("state_machine", "variables")
    assert type(model.state_machine) is EventStateMachine
    assert set(vars(model.state_machine)) == {"state", "period_s"}
    assert type(model.variables) is Variables
    assert Variables.__slots__ == ("_held", "undeclared")
    assert {type(variable) for variable in model.variables.values()} == {ModelVariable}
    for variable in model.variables.values():
        for field in dataclasses.fields(variable):
            assert isinstance(getattr(variable, field.name), Scalar | tuple | None)
    with pytest.raises(AttributeError):
        model.connection = object()  # type: ignore[attr-defined]


@given(events=st.lists(PERIODS))
def test_DigitalModel_ProcessEvent_delegates(events: list[int]) -> None:
    model, machine = DigitalModel(), EventStateMachine()
    for x in events:
        assert model.process_event(encode_period(x)) is machine.process_event(encode_period(x))
        assert (model.state, model.period_s) == (machine.state, machine.period_s)
        assert model.state is model.state_machine.state


def test_DigitalModel_variables_are_those_of_the_system_and_of_its_template() -> None:
    """With kind, unit and limits; a message in a transmitter's inbox is a command and not a variable."""
    system, _ = observatory()
    declared = DigitalModel(declared_variables(system)).variables
    assert declared["ctd.pressure"].declared() == {"kind": "real", "unit": "dbar"}
    assert declared["inclinometer.slope_long"].limits == (-327.68, 327.67)
    assert {name.partition(".")[0] for name in declared if "." in name} == set(system.devices)
    assert [name for name in declared if "." not in name] == list(system.plc.programs), "whether each runs"
    assert "modem.inbox" not in declared
    packed = json.loads(describe_model(system))["variables"]
    assert packed == {name: variable.declared() for name, variable in declared.items()}
    assert list(packed) == list(declared)


@given(
    told=st.lists(
        st.tuples(st.sampled_from(["a.x", "a.y", "b.z"]), st.integers() | st.none(), st.sampled_from(Quality))
    )
)
def test_DigitalModel_variables_change_by_events_alone_and_the_last_counts(
    told: list[tuple[str, int | None, Quality]],
) -> None:
    """The state does not depend on the variables, nor the variables on the state."""
    model, other = (DigitalModel([ModelVariable("a.x", "int"), ModelVariable("a.y", "int")]) for _ in range(2))
    model.process_event(encode_period(3))
    for t_ms, (name, value, quality) in enumerate(told, 1):
        assert model.variables.changed(name, value, quality, Reason.NONE, t_ms) is (name != "b.z")
    for name in ("a.x", "a.y"):
        last = max((n for n, (of, _, _) in enumerate(told) if of == name), default=None)
        held = model.variables[name]
        if last is None:
            assert (held.value, held.heard, held.quality, held.reason) == (None, False, Quality.BAD, Reason.NEVER_READ)
        else:
            assert (held.value, held.quality, held.t_ms) == (told[last][1], told[last][2], last + 1)
    assert model.variables.undeclared == sum(name == "b.z" for name, _, _ in told)
    assert model.period_s == 3
    assert not any(held.heard for held in other.variables.values()), "another instance"


def test_DigitalModel_is_another_instance_in_every_twin() -> None:
    one, other = (DigitalTwinPrototype(*observatory(), CLOCK) for _ in range(2))
    one.model.process_event(encode_period(5))
    one.model.variables.changed("ctd.pressure", 1.0, Quality.GOOD, Reason.NONE, 1)
    assert (one.model.variables["ctd.pressure"].value, other.model.variables["ctd.pressure"].value) == (1.0, None)
    assert type(one.model.state) is ACTIVE
    assert type(other.model.state) is STANDBY
    assert one.model.state_machine is not other.model.state_machine


@given(events=st.lists(PERIODS, max_size=12))
def test_DigitalModel_is_what_a_run_is_judged_by(events: list[int]) -> None:
    expected = ["STANDBY"]
    for x in events:
        if state_of(x).name != expected[-1]:
            expected.append(state_of(x).name)
    assert expected_states(events) == expected
