"""When programs of a PLC start. Defect: a program that ran before its inputs had been read computed with 0.0, and the result
was written."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import msgspec
import pytest

from fieldtwin.gateway.core.image.image import INPUTS, OUTPUTS, TagKind, TagSpec, message_tag
from fieldtwin.gateway.core.values import NEVER, Quality, Reason, Scalar, TagValue
from fieldtwin.plc.binding import InputBinding, image_for
from fieldtwin.plc.cycle.start import InputsMissing, StartPolicy
from fieldtwin.plc.cycle.task import StopReason
from fieldtwin.plc.runtime.config import PlcConfig, ProgramConfig, TaskSpec
from fieldtwin.plc.runtime.runner import TaskRunner

MS = 1_000_000
PLANT = {
    "sensor.temperature": TagSpec("sensor.temperature", TagKind.REAL),
    "sensor.open": TagSpec("sensor.open", TagKind.BOOL),
    "fan.mode": TagSpec("fan.mode", TagKind.INT),
    "modem.inbox": message_tag("modem.inbox", 8, 4),
}
ST = """
PROGRAM Fan
VAR_INPUT temperature : REAL; END_VAR
VAR_OUTPUT mode : INT; END_VAR
VAR since : TON; scans : DINT; first : DINT; done : BOOL; END_VAR
  since(IN := TRUE, PT := T#1s);
  done := since.Q;
  scans := scans + 1;
  IF temperature > 10.0 THEN mode := 2; ELSE mode := 1; END_IF
END_PROGRAM
"""
PYTHON = """
from fieldtwin.gateway.core.image.image import TagKind
from fieldtwin.plc.program import Program, message_input, var_input, var_local, var_output

class Fan(Program):
    temperature = var_input(TagKind.REAL)
    mode = var_output(TagKind.INT, initial=1)
    scans = var_local(TagKind.INT, initial=0)
    first = var_local(TagKind.INT, initial=0)

    def execute(self, scan):
        self.scans += 1
        self.first += scan.first_scan
        self.mode = 2 if (self.temperature or 0.0) > 10.0 else 1

class After(Program):
    mode = var_input(TagKind.INT)
    seen = var_local(TagKind.INT)

    def execute(self, scan):
        self.seen = self.mode if self.seen is None else self.seen

class Ping(Program):
    other = var_input(TagKind.INT)
    temperature = var_input(TagKind.REAL)
    count = var_local(TagKind.INT, initial=0)

    def execute(self, scan):
        self.count = self.other + 1

class Pong(Program):
    other = var_input(TagKind.INT)
    count = var_local(TagKind.INT, initial=0)

    def execute(self, scan):
        self.count = self.other + 1

class Mail(Program):
    temperature = var_input(TagKind.REAL)
    inbox = message_input()
    got = var_local(TagKind.INT, initial=0)

    def execute(self, scan):
        self.got += len(self.inbox)
"""
NEW = TaskSpec("main", 10)


class Rig:
    """A PLC over an image whose inputs the test publishes. `inputs` holds the gateway's current values."""

    def __init__(
        self, folder: Path, *programs: ProgramConfig, tasks: tuple[TaskSpec, ...] = (NEW,), **more: Any
    ) -> None:
        (folder / "fan.st").write_text(ST)
        self.module = f"start_{abs(hash(str(folder)))}"
        (folder / f"{self.module}.py").write_text(PYTHON)
        made = tuple(
            ProgramConfig(p.name, p.source.replace("MODULE", self.module), p.inputs, p.outputs, p.task, p.start)
            for p in programs
        )
        layout = image_for([p.bind((str(folder),)) for p in made], PLANT, ["sensor.open", "sensor.temperature"])
        memory = memoryview(bytearray(layout.size))
        layout.format(memory)
        self.image = layout.attach(memory)
        self.writer = self.image.writer(INPUTS)
        self.names = [t.name for t in layout.regions[0].tags]
        self.reader = self.image.reader(OUTPUTS)
        self.inputs: dict[str, TagValue] = {}
        self.messages: dict[str, list[tuple[int, bytes]]] = {}
        self.gateway = True
        self.now_ns = 0
        self.config = PlcConfig(
            "", layout.describe(), "", made, python_path=(str(folder),), tasks=tasks, retain_path=str(folder / "retain"), **more
        )  # fmt: skip
        self.runner = TaskRunner(self.config, self.image, lambda: self.now_ns)
        self.runner.start()

    def good(self, tag: str, value: Scalar, quality: Quality = Quality.GOOD) -> None:
        self.inputs[tag] = TagValue(value, quality, t_ns=max(1, self.now_ns))

    def until(self, ms: int) -> None:
        while self.runner.running and self.runner.deadline_ns <= ms * MS:
            self.now_ns = max(self.now_ns, self.runner.deadline_ns)
            if self.gateway:
                row = [self.inputs.get(n, NEVER if n in PLANT else TagValue(0, Quality.GOOD)) for n in self.names]
                self.writer.publish(row, self.now_ns, self.messages)
                self.messages = {}
            self.runner.run_once()
        self.now_ns = max(self.now_ns, ms * MS)

    def out(self, tag: str) -> Scalar | None:
        return self.reader.snapshot().value(tag).value

    @property
    def status(self) -> dict[str, Any]:
        return dict(msgspec.to_builtins(self.runner.status()))


def fan(source: str = "python: MODULE:Fan", if_bad: str | float = "pass", **policy: Any) -> ProgramConfig:
    binding = {"temperature": InputBinding("sensor.temperature", if_bad)}
    return ProgramConfig("fan", source, binding, {"mode": "fan.mode"}, "", StartPolicy(**policy))


@pytest.mark.parametrize("if_bad", ["pass", "hold", "trip", 5.0])
@pytest.mark.parametrize("source", ["fan.st", "python: MODULE:Fan"])
def test_outputs_have_no_value_until_every_input_was_good_once(
    tmp_path: Path, source: str, if_bad: str | float
) -> None:
    rig = Rig(tmp_path, fan(source, if_bad))
    seen = []
    for ms in range(10, 500, 10):
        if ms == 300:
            rig.good("sensor.temperature", 21.6)
        rig.until(ms)
        seen.append(rig.out("fan.mode"))
    assert list(dict.fromkeys(seen)) == [None, 2]
    assert seen.index(2) == 29  # the scan at 300 ms
    assert rig.status["state"] == "running"


def test_the_program_does_not_run_while_it_waits_and_its_timers_do_not_either(tmp_path: Path) -> None:
    rig = Rig(tmp_path, fan("fan.st"))
    rig.until(5_000)
    assert rig.status["scans"] == 0
    rig.good("sensor.temperature", 21.6)
    rig.until(5_990)
    assert rig.out("fan.done") is False
    rig.until(6_020)
    assert rig.out("fan.done") is True
    assert rig.out("fan.scans") == rig.status["scans"] == 102


def test_the_first_scan_is_the_first_that_the_program_executes(tmp_path: Path) -> None:
    rig = Rig(tmp_path, fan())
    rig.until(100)
    rig.good("sensor.temperature", 21.6)
    rig.until(200)
    assert (rig.out("fan.first"), rig.out("fan.scans")) == (1, 10)


def test_the_status_lists_missing_inputs_with_reasons(tmp_path: Path) -> None:
    rig = Rig(tmp_path, fan())
    rig.inputs["sensor.temperature"] = TagValue(None, Quality.BAD, Reason.TIMEOUT)
    rig.until(2_000)
    status = rig.status
    assert status["state"] == status["tasks"]["main"]["state"] == "waiting"
    waiting = status["waiting"]["fan"]
    assert waiting["inputs"] == {"sensor.temperature": "timeout"}
    assert waiting["reason"] == "sensor.temperature (timeout)"
    assert (waiting["since_s"], waiting["timeout_s"], waiting["overdue"]) == (1.99, 10.0, False)
    assert rig.runner.waits("fan.mode") == "sensor.temperature (timeout)"
    rig.gateway = False
    rig.until(4_000)
    assert rig.status["waiting"]["fan"]["inputs"] == {"sensor.temperature": "gateway dead"}
    json.dumps(rig.status)


@pytest.mark.parametrize("quality", [Quality.UNCERTAIN, Quality.BAD])
def test_a_value_that_is_not_good_does_not_start_a_program(tmp_path: Path, quality: Quality) -> None:
    rig = Rig(tmp_path, fan())
    rig.inputs["sensor.temperature"] = TagValue(21.6, quality, Reason.OUT_OF_RANGE, 1)
    rig.until(500)
    assert rig.status["state"] == "waiting"


def test_an_input_must_be_good_once_and_not_at_the_same_time_as_the_others(tmp_path: Path) -> None:
    both = {"temperature": InputBinding("sensor.temperature", "hold"), "other": InputBinding("fan.mode")}
    rig = Rig(tmp_path, ProgramConfig("ping", "python: MODULE:Ping", both))
    rig.good("fan.mode", 1)
    rig.until(100)
    rig.good("fan.mode", 1, Quality.BAD)
    rig.until(200)
    assert list(rig.status["waiting"]["ping"]["inputs"]) == ["sensor.temperature"]
    rig.good("sensor.temperature", 21.6)
    rig.until(300)
    assert rig.status["state"] == "running"


def test_after_the_timeout_the_program_continues_to_wait_and_reports_it(tmp_path: Path) -> None:
    rig = Rig(tmp_path, fan(timeout_ms=1_000.0))
    rig.until(3_000)
    status = rig.status
    assert (status["state"], rig.out("fan.mode"), status["waiting"]["fan"]["overdue"]) == ("waiting", None, True)
    assert "program fan has not started: it waits for sensor.temperature (never read)" in status["error"]
    assert "within 1 s" in status["error"]
    rig.good("sensor.temperature", 21.6)
    rig.until(3_010)
    assert (rig.status["state"], rig.status["error"], rig.out("fan.mode")) == ("running", "", 2)


def test_after_the_timeout_the_program_starts_anyway_if_the_policy_allows(tmp_path: Path) -> None:
    rig = Rig(tmp_path, fan("fan.st", timeout_ms=1_000.0, at_timeout="start_anyway"))
    rig.until(1_000)
    assert rig.out("fan.mode") is None
    rig.until(1_010)
    assert rig.out("fan.mode") == 1
    assert rig.status["started_without"] == {"fan": {"sensor.temperature": "never read"}}


def test_a_timeout_of_zero_does_not_wait(tmp_path: Path) -> None:
    rig = Rig(tmp_path, fan(timeout_ms=0.0, at_timeout="start_anyway"))
    rig.until(10)
    assert rig.out("fan.mode") == 1


def test_after_the_timeout_the_plc_stops_if_the_policy_requires(tmp_path: Path) -> None:
    rig = Rig(tmp_path, fan(timeout_ms=1_000.0, at_timeout="stop"))
    rig.until(3_000)
    status = rig.status
    assert (status["state"], status["stop_reason"]) == ("stopped", StopReason.NOT_STARTED.value)
    assert isinstance(rig.runner.error, InputsMissing)
    assert rig.reader.snapshot().stopped  # the gateway makes the outputs safe
    assert status["restarts"] == 0


def test_a_number_takes_the_place_of_an_input_when_the_time_is_over(tmp_path: Path) -> None:
    rig = Rig(tmp_path, fan(if_bad=20.0, timeout_ms=1_000.0))
    rig.until(1_000)
    assert rig.out("fan.mode") is None
    rig.until(1_010)
    assert rig.out("fan.mode") == 2


def test_a_forced_input_counts_as_good(tmp_path: Path) -> None:
    rig = Rig(tmp_path, fan())
    rig.until(100)
    rig.runner.force("sensor.temperature", 30.0)
    rig.until(110)
    assert rig.out("fan.mode") == 2


def test_a_forced_output_is_published_although_its_program_waits(tmp_path: Path) -> None:
    rig = Rig(tmp_path, fan())
    rig.runner.force("fan.mode", 7)
    rig.until(100)
    assert (rig.status["state"], rig.out("fan.mode")) == ("waiting", 7)


def test_each_program_waits_for_its_own_inputs_only(tmp_path: Path) -> None:
    other = ProgramConfig("pong", "python: MODULE:Pong", {"other": InputBinding("fan.mode")})
    rig = Rig(tmp_path, fan(), other)
    rig.good("fan.mode", 4)
    rig.until(100)
    assert (rig.out("pong.count"), rig.out("fan.scans")) == (5, None)
    status = rig.status
    assert (status["state"], status["tasks"]["main"]["state"], list(status["waiting"])) == (
        "waiting",
        "running",
        ["fan"],
    )


def test_a_program_waits_until_the_program_that_it_reads_has_run(tmp_path: Path) -> None:
    after = ProgramConfig("after", "python: MODULE:After", {"mode": InputBinding("fan.scans")})
    rig = Rig(tmp_path, after, fan())  # the reader is first in the task
    rig.until(100)
    assert rig.status["waiting"]["after"]["programs"] == ["fan"]
    rig.good("sensor.temperature", 21.6)
    rig.until(200)
    assert rig.out("after.seen") == 1  # not the initial value 0


def test_programs_that_read_each_other_wait_for_the_inputs_of_both(tmp_path: Path) -> None:
    inputs = {"temperature": InputBinding("sensor.temperature"), "other": InputBinding("pong.count")}
    ping = ProgramConfig("ping", "python: MODULE:Ping", inputs)
    pong = ProgramConfig("pong", "python: MODULE:Pong", {"other": InputBinding("ping.count")})
    rig = Rig(tmp_path, ping, pong)
    rig.until(100)
    assert list(rig.status["waiting"]) == ["ping", "pong"]
    rig.good("sensor.temperature", 21.6)
    rig.until(110)
    assert (rig.out("ping.count"), rig.out("pong.count")) == (1, 1)  # both read at the start of the scan


def test_no_message_is_lost_while_a_program_waits(tmp_path: Path) -> None:
    inputs = {"temperature": InputBinding("sensor.temperature"), "inbox": InputBinding("modem.inbox")}
    rig = Rig(
        tmp_path,
        ProgramConfig("mail", "python: MODULE:Mail", inputs),
        fan("fan.st", timeout_ms=0.0, at_timeout="start_anyway"),
    )
    rig.messages = {"modem.inbox": [(1, b"a"), (1, b"b")]}
    rig.until(100)
    assert rig.out("modem.inbox.consumed") == 0  # the gateway does not acknowledge an untaken message
    rig.good("sensor.temperature", 21.6)
    rig.until(200)
    assert (rig.out("mail.got"), rig.out("modem.inbox.consumed")) == (2, 2)


def test_no_message_is_lost_while_the_plc_is_paused(tmp_path: Path) -> None:
    inputs = {"temperature": InputBinding("sensor.temperature"), "inbox": InputBinding("modem.inbox")}
    rig = Rig(tmp_path, ProgramConfig("mail", "python: MODULE:Mail", inputs))
    rig.good("sensor.temperature", 21.6)
    rig.until(50)
    rig.runner.pause(True)
    rig.messages = {"modem.inbox": [(1, b"a")]}
    rig.until(100)
    rig.runner.pause(False)
    rig.until(150)
    assert rig.out("mail.got") == 1


def test_a_task_on_an_edge_is_not_run_by_a_trigger_that_becomes_known_as_true(tmp_path: Path) -> None:
    tasks = (NEW, TaskSpec("event", 0, 1, "sensor.open"))
    event = ProgramConfig(
        "event", "python: MODULE:Fan", {"temperature": InputBinding("sensor.temperature")}, {}, "event"
    )
    rig = Rig(tmp_path, fan(), event, tasks=tasks)
    rig.good("sensor.temperature", 21.6)
    rig.until(100)
    rig.good("sensor.open", True)  # read for the first time
    rig.until(200)
    rig.good("sensor.open", True, Quality.BAD)  # the link is down for a moment
    rig.until(300)
    rig.good("sensor.open", True)
    rig.until(400)
    assert rig.out("event.scans") is None
    rig.good("sensor.open", False)
    rig.until(500)
    rig.good("sensor.open", True)
    rig.until(600)
    assert rig.out("event.scans") == 1


def test_after_a_restart_of_the_programs_they_wait_again(tmp_path: Path) -> None:
    rig = Rig(tmp_path, fan())
    rig.good("sensor.temperature", 21.6)
    rig.until(100)
    rig.inputs["sensor.temperature"] = TagValue(21.6, Quality.BAD, Reason.TIMEOUT, 1)
    rig.until(200)
    assert rig.out("fan.mode") == 2
    rig.runner.restart()
    rig.until(300)
    assert (rig.status["state"], rig.out("fan.mode")) == ("waiting", None)
    rig.good("sensor.temperature", 21.6)
    rig.until(400)
    assert (rig.status["state"], rig.out("fan.mode")) == ("running", 2)


@pytest.mark.parametrize("source", ["fan.st", "python: MODULE:Fan"])
def test_a_gateway_that_begins_again_does_not_make_a_known_input_unknown(tmp_path: Path, source: str) -> None:
    """After a restart of the gateway alone its inputs have no value. Defect: the program saw 0.0 and switched the fan."""
    rig = Rig(tmp_path, fan(source))
    rig.good("sensor.temperature", 21.6)
    rig.until(100)
    rig.inputs.clear()  # the new gateway has read nothing yet
    rig.until(200)
    assert rig.out("fan.mode") == 2
    assert rig.runner.input("sensor.temperature").quality is Quality.BAD


def test_while_it_is_paused_a_program_does_not_become_overdue(tmp_path: Path) -> None:
    rig = Rig(tmp_path, fan(timeout_ms=1_000.0, at_timeout="stop"))
    rig.runner.pause(True)
    rig.until(5_000)
    assert rig.status["state"] == "paused"
    rig.runner.pause(False)
    rig.until(5_500)
    assert rig.status["state"] == "waiting"
