"""The paper's ControlLogic with rulings 1, 2, 5, 6, 17; Relay as a program with full mailboxes."""

from __future__ import annotations

import json
import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldtwin.gateway.core.concurrency.events import Consumer
from fieldtwin.gateway.core.errors import Bug
from fieldtwin.gateway.core.image.image import Message
from fieldtwin.gateway.core.statemachine import STATE_CODES, encode_period
from fieldtwin.gateway.core.values import COMMAND, MEASUREMENT, RESPONSE, STATUS
from fieldtwin.plc.program import ScanInfo, SourceLine
from fieldtwin.plc.relay import LOG_CAPACITY, QUEUE_CAPACITY, ControlLogic, DataLog, LogEntry, Relay

PERIODS = st.integers(-32768, 32767)


def logic_with_ears() -> tuple[ControlLogic, Consumer[COMMAND], Consumer[RESPONSE]]:
    logic = ControlLogic()
    commands: Consumer[COMMAND] = Consumer("command", 1000)
    responses: Consumer[RESPONSE] = Consumer("response", 1000)
    logic.command.subscribe(commands)
    logic.response.subscribe(responses)
    return logic, commands, responses


def scan_at(number: int) -> ScanInfo:
    return ScanInfo(number * 10_000_000, number, number == 1)


def command(seq: int, period_s: int) -> Message:
    return Message(seq, 0, encode_period(period_s).data)


def test_init_is_period_0_an_empty_log_and_standby() -> None:
    logic = ControlLogic()
    assert (logic.period_s, len(logic.data_log), logic.machine.state.name) == (0, 0, "STANDBY")
    assert not logic.sensor.queue
    assert not logic.transmitter.queue
    assert (logic.sensor.event, logic.transmitter.event) == ("sensor", "transmitter")


@given(st.lists(PERIODS, max_size=20))
def test_send_cmd_relays_every_command_in_order_and_logs_those_of_positive_period(periods: list[int]) -> None:
    logic, commands, _ = logic_with_ears()
    for period_s in periods:
        logic.transmitter.observe(encode_period(period_s))
    logic.send_cmd(5)
    assert list(commands.queue) == [encode_period(p) for p in periods]
    assert [e.data for e in logic.data_log] == [encode_period(p).data for p in periods if p > 0]
    assert logic.period_s == (periods[-1] if periods else 0)
    assert not logic.transmitter.queue
    last = periods[-1] if periods else 0
    assert logic.machine.state.name == ("ACTIVE" if last > 0 else "STANDBY" if last == 0 else "OFF")


@given(st.lists(st.binary(max_size=30), max_size=20), PERIODS)
def test_send_rsp_emits_payloads_unaltered_and_logs_while_active(payloads: list[bytes], period_s: int) -> None:
    logic, _, responses = logic_with_ears()
    logic.set_period(encode_period(period_s))
    sent = [(MEASUREMENT if i % 2 else STATUS)(data) for i, data in enumerate(payloads)]
    for item in sent:
        logic.sensor.observe(item)
    logic.send_rsp(7)
    assert list(responses.queue) == sent
    assert list(logic.data_log) == [LogEntry(7, "response", d) for d in payloads if period_s > 0]
    assert not logic.sensor.queue


@pytest.mark.parametrize("period_s", [0, -1])
def test_log_data_needs_a_positive_period(period_s: int) -> None:
    logic = ControlLogic()
    logic.set_period(encode_period(period_s))
    with pytest.raises(Bug, match="nothing is sampled"):
        logic.log_data("response", RESPONSE(b"x"), 1)
    assert len(logic.data_log) == 0


@pytest.mark.parametrize("data", [b"", b"\1", b"\0\1\2"])
def test_an_invalid_command_changes_nothing_and_is_counted(data: bytes) -> None:
    logic, commands, _ = logic_with_ears()
    for item in (encode_period(3), COMMAND(data), encode_period(4)):
        logic.transmitter.observe(item)
    logic.send_cmd(1)
    assert [c.data for c in commands.queue] == [b"\0\3", b"\0\4"]
    assert (logic.commands, logic.bad_commands, logic.period_s) == (2, 1, 4)
    assert [e.kind for e in logic.data_log] == ["command", "bad command", "command"]


def test_the_log_is_bounded_keeps_duplicates_and_counts_dropped_entries() -> None:
    log = DataLog(3)
    for n in range(5):
        log.append(LogEntry(n, "command", b"same"))
    assert [e.t_ns for e in log] == [2, 3, 4]
    assert (log.total, log.dropped) == (5, 2)


def test_the_same_command_twice_is_two_commands() -> None:
    relay = Relay()
    relay.command = (command(1, 2), command(2, 2))
    relay.execute(scan_at(1))
    assert (relay.commands, relay.period_s, relay.state) == (2, 2, STATE_CODES["ACTIVE"])


def test_off_is_not_absorbing() -> None:
    relay, seen = Relay(), []
    for n, period_s in enumerate((1, 0, -1, 2), 1):
        relay.command = (command(n, period_s),)
        relay.execute(scan_at(n))
        seen.append((relay.state, relay.period_s))
    codes = STATE_CODES
    assert seen == [(codes["ACTIVE"], 1), (codes["STANDBY"], 0), (codes["OFF"], -1), (codes["ACTIVE"], 2)]


def test_a_full_mailbox_means_wait_counted_then_everything_in_order() -> None:
    relay = Relay()
    relay.response.depth = 2
    samples = [bytes([n]) for n in range(5)]
    relay.sample = tuple(Message(n + 1, 0, data) for n, data in enumerate(samples))
    arrived: list[bytes] = []
    for n in range(1, 5):
        relay.execute(scan_at(n))
        relay.sample = ()
        new = [data for _, data in relay.response.pending]
        assert len(new) <= 2
        arrived += new
        if n == 1:
            assert (relay.waiting, relay.response.waits) == (3, 1)
            relay.response.outstanding, relay.response.pending = 2, []
        else:  # the gateway took the waiting messages
            relay.response.outstanding, relay.response.pending = 0, []
    assert arrived == samples
    assert (relay.waiting, relay.dropped, relay.responses) == (0, 0, 5)


def test_messages_beyond_the_queue_are_dropped_oldest_first_and_counted() -> None:
    relay = Relay()
    relay.response.outstanding = relay.response.depth
    total = QUEUE_CAPACITY + 44
    for n in range(0, total, 20):
        relay.sample = tuple(Message(i + 1, 0, bytes([i % 256])) for i in range(n, n + 20))
        relay.execute(scan_at(n + 1))
    assert (relay.waiting, relay.dropped) == (QUEUE_CAPACITY, total - QUEUE_CAPACITY)
    relay.sample, relay.response.outstanding = (), 0
    relay.execute(scan_at(999))
    assert relay.response.pending[0][1] == bytes([44])


def test_a_response_longer_than_the_mailbox_is_dropped_not_raised() -> None:
    relay = Relay()
    relay.response.max_bytes = 4
    relay.sample = (Message(1, 0, b"12345"), Message(2, 0, b"1234"))
    relay.execute(scan_at(1))
    assert [data for _, data in relay.response.pending] == [b"1234"]
    assert relay.dropped == 1


def test_the_log_leaves_as_messages_once_each_and_waits_for_room() -> None:
    relay = Relay()
    relay.log.depth = 3
    relay.command = (command(1, 5),)
    relay.sample = tuple(Message(n, 0, bytes([n])) for n in range(1, 5))
    got: list[dict[str, object]] = []
    for n in range(1, 4):
        relay.execute(scan_at(n))
        relay.command = relay.sample = ()
        got += [json.loads(data) for _, data in relay.log.pending]
        relay.log.pending = []
    assert [(e["kind"], e["data"]) for e in got] == [
        ("command", "0005"),
        *(("response", f"{n:02x}") for n in range(1, 5)),
    ]
    assert {e["t_ns"] for e in got} == {10_000_000}
    assert relay.logged == 5


def test_log_entries_that_were_not_taken_in_time_are_counted() -> None:
    relay = Relay()
    relay.log.outstanding = relay.log.depth
    relay.command = (command(1, 1),)
    for n in range(1, LOG_CAPACITY // 16 + 3):
        relay.sample = tuple(Message(i, 0, b"") for i in range(16))
        relay.execute(scan_at(n))
        relay.command, relay.response.pending = (), []
    assert relay.logged == 1 + 16 * (LOG_CAPACITY // 16 + 2)
    assert relay.dropped == relay.logged - LOG_CAPACITY


def test_the_line_of_an_imported_program_does_not_depend_on_where_it_is_installed() -> None:
    """Defect: the trace of a seed held an absolute path, so it was another one in another folder."""
    place = str(SourceLine(code=Relay.execute.__code__))
    assert re.fullmatch(r"fieldtwin/plc/relay\.py:[0-9]+", place)
