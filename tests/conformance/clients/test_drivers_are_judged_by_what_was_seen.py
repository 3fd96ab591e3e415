"""A driver fails only for its own behaviour, and passes only if the probe could see its published values.

Defects: MB-021 failed a client that reported an exception at once and then backed off for about its timeout. MB-015b
passed or failed minimalmodbus depending on the caller's pause, because the late reply to one request was taken for the
reply to the next. Clients that printed 0, 42 or 65535 for an exception passed MB-021 and MB-024, and canopen passed
CO-030 although it printed 0.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path

import pytest
from clients_in_memory import Publish, judge
from test_third_party_clients_judged import CANOPEN, run_check

from fieldtwin.conformance.clients.probe import Classifier, MarkedOutputProbe, OutputProbe
from fieldtwin.conformance.core.observation import Word
from fieldtwin.emulators.endpoints.memory_ports import MemoryNet
from fieldtwin.emulators.modbus.rtu.receiver import crc16, with_crc
from fieldtwin.emulators.virtual.clock import VirtualClock
from fieldtwin.gateway.core.connection import ByteConnection
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import Unreachable
from fieldtwin.results.model import Verdict

pytestmark = pytest.mark.long

REQUEST = bytes((17, 3, 0, 107, 0, 2))
LINE = "rtu:/line?baudrate=19200"
TIMEOUT_S = 0.2


async def _frame(line: ByteConnection, *, sees_short: bool) -> bytes:
    """Read a reply of the expected length, or the bytes received before the timeout. With `sees_short`, accept 5 bytes
    of an exception."""
    got = b""
    try:
        async with asyncio.timeout(TIMEOUT_S):
            while len(got) < 9 and not (sees_short and len(got) == 5 and got[1] & 0x80):
                got += await line.read()
    except TimeoutError:
        pass
    return got


def _poller(
    pause_s: float, backs_off_s: float = 0.0, *, sees_short: bool = True, flushes: bool = False
) -> Callable[..., object]:
    """A correct client on a serial line, except for the options. `flushes`: it gives up at the first frame that is not
    its own, and discards its input before the next request, as minimalmodbus does."""

    async def poll(net: MemoryNet, endpoint: Endpoint, clock: VirtualClock, publish: Publish) -> None:
        line = await net.open_bytes(endpoint)
        while True:
            if flushes:
                line.read_pending()
            await line.write(with_crc(REQUEST))
            got = await _frame(line, sees_short=sees_short)
            if len(got) == 9 and got[:3] == b"\x11\x03\x04" and crc16(got) == 0:
                publish(str(int.from_bytes(got[3:5], "big")))
            await asyncio.sleep(backs_off_s if len(got) == 5 and backs_off_s else pause_s)

    return poll


@pytest.mark.parametrize(
    ("client", "verdict", "says"),
    [
        (_poller(0.05, 0.21), Verdict.PASSED, ""),
        (_poller(0.05, 0.25), Verdict.INCONCLUSIVE, "it backs off"),
        (_poller(0.05, 0.60), Verdict.INCONCLUSIVE, "it backs off"),
        (_poller(0.05), Verdict.PASSED, ""),
        (_poller(0.05, sees_short=False), Verdict.FAILED, "it waits out its timeout"),
    ],
)
def test_a_client_that_backs_off_does_not_count_as_waiting_for_silence(
    client: Callable[..., object], verdict: Verdict, says: str
) -> None:
    result = judge(client, LINE, "MB-021")["MB-021"]  # type: ignore[arg-type]
    assert (result.verdict, says in result.reason) == (verdict, True), result.reason


def test_without_the_timeout_a_wait_after_an_exception_is_inconclusive() -> None:
    result = judge(_poller(0.05, sees_short=False), LINE, "MB-021", timeout_s=0.0)["MB-021"]  # type: ignore[arg-type]
    assert (result.verdict, "give --timeout" in result.reason) == (Verdict.INCONCLUSIVE, True), result.reason


@pytest.mark.parametrize("pause_s", [0.002, 0.005, 0.020, 0.030, 0.100, 0.300])
def test_a_client_that_gives_up_at_another_units_reply_fails_whatever_its_pause(pause_s: float) -> None:
    result = judge(_poller(pause_s, flushes=True), LINE, "MB-015b")["MB-015b"]  # type: ignore[arg-type]
    assert result.verdict is Verdict.FAILED, result.reason


MINIMALMODBUS = """
import os, time, minimalmodbus
device = minimalmodbus.Instrument(os.environ["FIELDTWIN_TTY"], 1)
device.serial.baudrate, device.serial.timeout = 19200, 0.15
while True:
    try:
        print(device.read_registers(0, 2)[0], flush=True)
    except Exception as e:
        print(type(e).__name__, flush=True)
    time.sleep({pause_s})
"""


@pytest.mark.parametrize("pause_s", [0.005, 0.020, 0.100])
def test_minimalmodbus_fails_on_another_units_reply_at_every_pause(tmp_path: Path, pause_s: float) -> None:
    args = ("modbus-client", "--listen", f"pty:{tmp_path}/line", "--timeout", "150ms", "--only", "15b")
    code, found, said = run_check(tmp_path, *args, program=MINIMALMODBUS.format(pause_s=pause_s))
    assert (code, found["MB-015b"][0]) == (1, "failed"), (found, said)


PUBLISHES = """
import os, socket, time
link = socket.create_connection((os.environ["FIELDTWIN_HOST"], int(os.environ["FIELDTWIN_PORT"])))
link.settimeout(5)
number = 0
while True:
    number += 1
    link.sendall(bytes((number >> 8 & 255, number & 255, 0, 0, 0, 6, 1, 3, 0, 0, 0, 1)))
    reply = link.recv(100)
    if reply[7] & 0x80:
        print("{refused}", flush=True)
        time.sleep(0.1)
    else:
        print("{good}" % int.from_bytes(reply[-2:], "big"), flush=True)
    time.sleep(0.02)
"""
MODBUS = ("modbus-client", "--listen", "tcp://127.0.0.1:0", "--timeout", "5s", "--only", "21,24")


@pytest.mark.parametrize("value", ["0", "42", "65535", "0.0"])
def test_a_value_that_is_printed_for_an_exception_is_seen_by_the_output_probe(tmp_path: Path, value: str) -> None:
    code, found, said = run_check(tmp_path, *MODBUS, program=PUBLISHES.format(refused=value, good="%d"))
    assert code == 1, said
    for case in ("MB-021", "MB-024"):
        assert found[case][0] == "failed", found
        assert f"published {value}, which no correct answer contained" in found[case][1]


def test_a_number_in_a_line_of_another_form_is_inconclusive_with_the_way_out(tmp_path: Path) -> None:
    code, found, said = run_check(tmp_path, *MODBUS, program=PUBLISHES.format(refused="level is 42", good="%d"))
    assert code == 1, said
    for case in ("MB-021", "MB-024"):
        assert found[case][0] == "inconclusive", found
    assert "'level is 42'" in found["MB-024"][1]
    assert "give a tcp:// probe" in found["MB-024"][1]


def test_with_a_mark_before_each_value_other_numbers_are_not_values(tmp_path: Path) -> None:
    program = PUBLISHES.format(refused="exception 6 at 12 o'clock", good="level=%d")
    code, found, said = run_check(tmp_path, *MODBUS, program=program, probe="output:level=")
    assert code == 0, (found, said)
    assert found["MB-024"][0] == "passed", found


def test_canopens_client_publishes_0_for_an_empty_value(tmp_path: Path) -> None:
    args = ("canopen-master", "--listen", "can:fieldtwin/127.0.0.1:0", "--timeout", "150ms", "--only", "30")
    code, found, said = run_check(tmp_path, *args, program=CANOPEN)
    assert (code, found["CO-030"][0]) == (1, "failed"), (found, said)
    assert "published 0, which no correct answer contained" in found["CO-030"][1]


def test_only_the_places_of_values_in_lines_of_known_forms_are_values() -> None:
    probe = OutputProbe({1111: Word.FIRST, 2222: Word.SECOND, 3333: Word.POISON})
    seen: list[tuple[Word, str]] = []
    probe.on_shown = lambda word, text: seen.append((word, text))
    probe.feed("poll 1: level 1111\n")
    assert probe.learn(Word.FIRST)
    probe.feed("poll 2: level 2222\n")
    assert probe.learn(Word.SECOND)
    seen.clear()
    probe.feed("poll 1111: level 2222\npoll 3333: level 0\npoll 4: level 3333\nno reply\nretry 5\n")
    assert seen == [(Word.SECOND, "2222"), (Word.OTHER, "0"), (Word.POISON, "3333"), (Word.UNCLEAR, "retry 5")]


def test_a_marked_text_that_is_not_a_number_is_not_a_value() -> None:
    probe = MarkedOutputProbe("level=", Classifier(3333, frozenset({"-1"})))
    seen: list[tuple[Word, str]] = []
    probe.on_shown = lambda word, text: seen.append((word, text))
    probe.feed("level=11.11, 5 left\n")
    assert probe.learn(Word.FIRST)
    probe.feed("level=11.11\nlevel=None\nlevel=-1\nlevel=3333\nlevel=0\n7\n")
    assert [word for word, _ in seen[1:]] == [Word.FIRST, Word.NONE, Word.NONE, Word.POISON, Word.OTHER]


async def _rounds(net: MemoryNet, endpoint: Endpoint, clock: VirtualClock, publish: Publish) -> None:
    line = await net.open_bytes(endpoint)
    while True:
        await line.write(with_crc(REQUEST))
        await _frame(line, sees_short=True)
        publish("0.0")
        await asyncio.sleep(0.05)


def test_a_client_that_rounds_the_value_is_told_what_the_probe_showed() -> None:
    with pytest.raises(Unreachable, match=r"expected the register 2222, .*without rounding; got '0\.0'"):
        judge(_rounds, LINE, "MB-021")


def test_output_probes_keep_the_latest_line_for_a_message() -> None:
    for probe in (OutputProbe({}), MarkedOutputProbe("level=", Classifier(3333))):
        assert probe.latest_text() == ""
        probe.feed("level=1\nlevel of 0.0 degC\n\n")
        probe.feed("an error\n", log=True)
        assert probe.latest_text() == "level of 0.0 degC"


def _gives_up_at_the_first_adu(pause_s: float) -> Callable[..., object]:
    """A Modbus TCP client that reads no second ADU if the first has a different transaction id, as modbus_tk does."""

    async def poll(net: MemoryNet, endpoint: Endpoint, clock: VirtualClock, publish: Publish) -> None:
        link = await net.open_bytes(endpoint)
        number = 0
        while True:
            number = number % 0x3FFF + 1
            link.read_pending()
            await link.write(number.to_bytes(2, "big") + bytes((0, 0, 0, 6)) + REQUEST)
            try:
                async with asyncio.timeout(TIMEOUT_S):
                    reply = await link.read()
            except TimeoutError:
                reply = b""
            if len(reply) >= 13 and int.from_bytes(reply[:2], "big") == number:
                publish(str(int.from_bytes(reply[9:11], "big")))
            await asyncio.sleep(pause_s)

    return poll


@pytest.mark.parametrize("pause_s", [0.005, 0.016, 0.020, 0.021, 0.030])
def test_a_correct_answer_at_the_end_of_a_case_is_not_taken_for_an_odd_one(pause_s: float) -> None:
    """The device answered correctly with the value of the case until its last delayed frame was sent."""
    result = judge(_gives_up_at_the_first_adu(pause_s), "tcp://plc:502", "MB-056c")["MB-056c"]  # type: ignore[arg-type]
    assert (result.verdict, "were not accepted" in result.reason) == (Verdict.FAILED, True), result.reason
