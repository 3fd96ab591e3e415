"""Schema ControlLogic: the object inside the program that the PLC runs (fieldtwin.plc.relay.Relay)."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from spec_rig import observatory

from fieldtwin.gateway.core.concurrency.events import Consumer, Producer
from fieldtwin.gateway.core.errors import Bug, Desync
from fieldtwin.gateway.core.statemachine import encode_period
from fieldtwin.gateway.core.values import COMMAND, MEASUREMENT, RESPONSE
from fieldtwin.plc.relay import LOG_CAPACITY, ControlLogic, DataLog, LogEntry, Relay
from fieldtwin.twin.plant.physical import EmbeddedControlSystem

PERIODS = st.integers(-32768, 32767)
PAYLOADS = st.lists(st.binary(max_size=20), max_size=10)


class Listeners:
    """A control logic, and consumers of its events."""

    def __init__(self) -> None:
        self.logic = ControlLogic()
        self.commands: Consumer[COMMAND] = Consumer("command", 1000)
        self.responses: Consumer[RESPONSE] = Consumer("response", 1000)
        self.logic.command.subscribe(self.commands)
        self.logic.response.subscribe(self.responses)

    def send(self, *periods: int) -> None:
        for period_s in periods:
            self.logic.transmitter.observe(encode_period(period_s))
        self.logic.send_cmd(1)

    @property
    def log(self) -> list[tuple[str, bytes]]:
        return [(entry.kind, entry.data) for entry in self.logic.data_log]


def test_ControlLogic_is_what_the_observatorys_PLC_runs() -> None:
    (config,) = EmbeddedControlSystem(observatory()[0]).control_logic
    program = config.bind().program
    assert isinstance(program, Relay)
    assert type(program.logic) is ControlLogic


def test_ControlLogic_has_two_consumers_and_two_producers() -> None:
    logic = ControlLogic()
    assert isinstance(logic.sensor, Consumer)
    assert isinstance(logic.transmitter, Consumer)
    assert isinstance(logic.response, Producer)
    assert isinstance(logic.command, Producer)


def test_ControlLogic_Init_is_period_0_an_empty_log_and_empty_queues() -> None:
    logic = ControlLogic()
    assert logic.period_s == 0
    assert len(logic.data_log) == 0
    assert not logic.sensor.queue
    assert not logic.transmitter.queue


@given(periods=st.lists(PERIODS, min_size=1))
def test_ControlLogic_SetPeriod_sets_it(periods: list[int]) -> None:
    logic = ControlLogic()
    for period_s in periods:
        logic.set_period(encode_period(period_s))
        assert logic.period_s == period_s


@given(period_s=PERIODS, data=st.binary(max_size=4))
def test_ControlLogic_LogData_needs_a_positive_period(period_s: int, data: bytes) -> None:
    logic = ControlLogic()
    logic.set_period(encode_period(period_s))
    if period_s > 0:
        logic.log_data("response", RESPONSE(data), 1)
        assert [entry.data for entry in logic.data_log] == [data]
    else:
        with pytest.raises(Bug, match="period > 0"):
            logic.log_data("response", RESPONSE(data), 1)
        assert len(logic.data_log) == 0


@given(periods=st.lists(PERIODS, max_size=20))
def test_ControlLogic_sendCmd_drains_the_transmitter_queue_and_relays_every_command(periods: list[int]) -> None:
    """Rulings 1 and 5: a period is always relayed, also 0 and negative; emitting never waits for the log."""
    listeners = Listeners()
    listeners.send(*periods)
    assert not listeners.logic.transmitter.queue
    assert list(listeners.commands.queue) == [encode_period(p) for p in periods]
    assert listeners.logic.period_s == (periods[-1] if periods else 0)


@given(periods=st.lists(PERIODS, max_size=20))
def test_ControlLogic_sendCmd_logs_under_the_period_as_it_is_after_SetPeriod(periods: list[int]) -> None:
    """Ruling 1: the command that starts sampling is logged, the one that ends it is not."""
    listeners = Listeners()
    listeners.send(*periods)
    assert listeners.log == [("command", encode_period(p).data) for p in periods if p > 0]


def test_ControlLogic_the_same_command_twice_is_two_commands() -> None:
    """Rulings 2 and 17."""
    listeners = Listeners()
    listeners.send(5, 5)
    assert len(listeners.commands.queue) == 2
    assert listeners.log == [("command", b"\0\5")] * 2


@given(payloads=PAYLOADS, period_s=PERIODS)
def test_ControlLogic_sendRsp_drains_the_sensor_queue_and_emits_payloads_unaltered(
    payloads: list[bytes], period_s: int
) -> None:
    listeners = Listeners()
    listeners.send(period_s)
    responses = [MEASUREMENT(p) for p in payloads]
    for response in responses:
        listeners.logic.sensor.observe(response)
    listeners.logic.send_rsp(2)
    assert not listeners.logic.sensor.queue
    assert all(emitted is response for emitted, response in zip(listeners.responses.queue, responses, strict=True))
    logged = [data for kind, data in listeners.log if kind == "response"]
    assert logged == (payloads if period_s > 0 else [])


@given(bits=st.binary(max_size=5).filter(lambda b: len(b) != 2))
def test_ControlLogic_data_that_is_not_a_command_changes_nothing(bits: bytes) -> None:
    """Ruling 11: a case that the paper omits gives a typed error, here a count and an entry in the log."""
    listeners = Listeners()
    listeners.send(3)
    with pytest.raises(Desync):
        listeners.logic.set_period(COMMAND(bits))
    listeners.logic.transmitter.observe(COMMAND(bits))
    listeners.logic.send_cmd(1)
    assert listeners.logic.period_s == 3
    assert listeners.logic.bad_commands == 1
    assert len(listeners.commands.queue) == 1


def test_ControlLogic_dataLog_is_bounded_ordered_and_keeps_duplicates() -> None:
    """Ruling 2."""
    log = DataLog()
    entries = [LogEntry(i // 2, "response", bytes([i // 2 % 256])) for i in range(LOG_CAPACITY + 6)]
    for entry in entries:
        log.append(entry)
    assert list(log) == entries[6:]
    assert (log.dropped, log.total) == (6, len(entries))
