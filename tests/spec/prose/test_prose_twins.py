"""The paper's statements about twins, each on a small scale; tests/interop and tests/system test them with whole runs."""

from __future__ import annotations

import asyncio
import json
import struct
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from click.testing import CliRunner
from shadow_rig import DECLARED, NOW_MS, Hands, status, value
from spec_rig import CHECKOUT, CLOCK, Rig, observatory, rig
from support import eventually, run
from wire_rig import Crossed, relay, strange_device

from fieldtwin.cli.recordings.compare_command import command as compare_command
from fieldtwin.cli.twin.shadow_command import exit_code, print_shadow
from fieldtwin.emulators.models.modbus.distorted_registers import DistortedRegisters
from fieldtwin.emulators.replay.replay import ExchangeReplay
from fieldtwin.emulators.replay.unit import ReplayUnit
from fieldtwin.gateway.connections.sockets.listeners import TcpListener
from fieldtwin.gateway.core.concurrency.events import Consumer, Producer
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.files.recording import RecordedExchange, RecordingHeader, RecordingReader, RecordingWriter
from fieldtwin.gateway.core.statemachine import decode_period, encode_period
from fieldtwin.gateway.core.values import COMMAND, MEASUREMENT, RESPONSE, STATUS, Quality, Reason
from fieldtwin.gateway.devices.transmitter import TransmitterDriver
from fieldtwin.gateway.store.event import Event, Kind
from fieldtwin.gateway.store.sqlite_knowledge import SqliteKnowledge, in_place
from fieldtwin.run.shadow.shadow import Shadowing
from fieldtwin.run.what_if.asked import objection
from fieldtwin.run.what_if.asking import QuestionMessage
from fieldtwin.run.what_if.fork import Fork, answer
from fieldtwin.run.what_if.last_known import of_period
from fieldtwin.run.what_if.plan import WhatIfPlan
from fieldtwin.run.what_if.state import KnownState
from fieldtwin.twin.model.mape.execute import CommandLimits
from fieldtwin.twin.model.mape.messages import SeenMeasurement, SeenStatus
from fieldtwin.twin.model.mape.plan import PlanRule, RulePlanner
from fieldtwin.twin.model.shadow import DigitalShadow
from fieldtwin.twin.model.thread_process import ReceivingEnd
from fieldtwin.twin.model.twin import DigitalTwin
from fieldtwin.twin.plant.declared import declared_variables
from fieldtwin.twin.plant.instance import Instance
from fieldtwin.twin.prototype.file import load_prototype
from fieldtwin.twin.prototype.prototype import DigitalTwinPrototype
from fieldtwin.twin.site.system import load_system
from fieldtwin.twin.thread.end import ThreadEnd
from fieldtwin.twin.thread.frames import ACK, ASK, REFUSED
from fieldtwin.twin.thread.tcp import WHO, TcpListening
from fieldtwin.twin.thread.thread import schema_of

# -- 1: the driver cannot distinguish an emulator from the device -----------------------------------------------------


async def mailbox_talk(r: Rig) -> None:
    """The work of a transmitter's driver: it reads which messages were taken, takes a message, acknowledges it, sends one."""
    driver = r.register_driver("modem")
    assert isinstance(driver, TransmitterDriver)
    subscriber: Consumer[COMMAND] = Consumer(driver.emitter.event)
    driver.emitter.subscribe(subscriber)  # type: ignore[arg-type]
    await driver.synchronise()
    await driver.receive("inbox")
    await driver.acknowledge()
    driver.consumer.observe(RESPONSE(b"\0\5"))
    await driver.send()


def with_message(r: Rig) -> Endpoint:
    """The emulated modem with a message in its inbox: 1, 2 bytes, a period of 9."""
    bank = r.unit("modem").bank
    assert isinstance(bank, DistortedRegisters)
    bank.bank._cells.poke("holding", 0, 1, 2, 9)  # type: ignore[attr-defined]
    return r.field.listening["lan"]


def swapped(pdu: bytes) -> bytes:
    return pdu[:2] + pdu[4:6] + pdu[2:4] + pdu[6:] if len(pdu) > 20 else pdu


async def both_talks(folder: Path, spoilt: object = bytes) -> tuple[Crossed, Crossed]:
    """The same driver with the same configuration, against our emulator and against an independent device."""
    async with (
        rig(folder) as emulated,
        relay(with_message(emulated)) as emulator,
        rig(folder, carried={"lan": emulator.endpoint}) as r,
    ):
        await mailbox_talk(r)
    async with (
        strange_device({0: 1, 1: 2, 2: 9}, spoilt) as device,  # type: ignore[arg-type]
        relay(device) as stranger,
        rig(folder, carried={"lan": stranger.endpoint}) as r,
    ):
        await mailbox_talk(r)
    return emulator, stranger


def exchanges(crossed: Crossed) -> list[RecordedExchange]:
    """Return the exchanges of the conversation, one by one."""
    found = []
    for request, reply in zip(adus(crossed.there), adus(crossed.back), strict=True):
        assert request[:2] == reply[:2], "of one transaction"
        found.append(RecordedExchange(float(len(found)), request[6], request[7:], reply[7:]))
    return found


def adus(stream: bytearray) -> list[bytes]:
    found = []
    while stream[len(b"".join(found)) :]:
        rest = stream[len(b"".join(found)) :]
        found.append(bytes(rest[: 6 + struct.unpack(">H", rest[4:6])[0]]))
    return found


def test_prose_1_the_same_driver_asks_emulator_and_device_the_same_and_is_answered_alike(tmp_path: Path) -> None:
    """tests/interop/flagship/test_flagship.py compares a whole system, with tolerances in a reviewed file."""
    emulator, stranger = run(both_talks(tmp_path))
    assert emulator.there == stranger.there, "request bytes are identical"
    assert emulator.back == stranger.back
    assert len(exchanges(emulator)) >= 6


def test_prose_1_a_planted_difference_is_seen(tmp_path: Path) -> None:
    emulator, stranger = run(both_talks(tmp_path, swapped))
    assert emulator.back != stranger.back


# -- 4: a shadow sends nothing that could change the physical twin --------------------------------------------------------


def test_prose_4_the_shadows_modules_load_nothing_that_could_send() -> None:
    """By construction: the shadow's modules import nothing that sends. The import contract of the same name is checked at
    every commit."""
    program = "import sys, fieldtwin.twin.model.shadow; print(*sys.modules)"
    loaded = subprocess.run(
        [sys.executable, "-c", program], cwd=CHECKOUT, capture_output=True, text=True, check=True, timeout=30
    ).stdout.split()
    contracts = tomllib.loads((CHECKOUT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    (contract,) = [c for c in contracts if c["name"] == "a shadow holds nothing that can send a command"]
    forbidden = contract["forbidden_modules"]
    assert {
        "fieldtwin.gateway.connections",
        "fieldtwin.gateway.devices",
        "fieldtwin.twin.thread.thread",
        "fieldtwin.twin.thread.end",
    } <= set(forbidden)
    assert "fieldtwin.twin.model.shadow" in loaded
    assert not [m for m in loaded if any(m == f or m.startswith(f"{f}.") for f in forbidden)]


def test_prose_4_a_wire_capture_towards_the_plant_holds_no_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A shadow as `fieldtwin shadow` runs it, with a plant that reports everything, received commands included."""
    monkeypatch.setenv("FIELDTWIN_RUN", str(tmp_path))
    system = observatory()[0]
    schema = schema_of(system)

    async def main() -> Crossed:
        store = await SqliteKnowledge.open(tmp_path / "plant.db", offload=in_place)
        origin = await store.own("plant", system=system.name, prototype=True, log="1")
        now_ms = CLOCK.utc_ns() // 1_000_000
        told = [value(1.0, now_ms), status(5, t_ms=now_ms), Event(0, now_ms, Kind.COMMAND, "modem.inbox", b"\0\7")] * 40
        await store.append(origin, told)
        carrier = await TcpListening.start(Endpoint.parse("tcp://127.0.0.1:0"), TcpListener.open, [schema])
        end = ThreadEnd(store, carrier, schema, CLOCK, origin=origin, prototype=True)
        stop = asyncio.Event()
        async with relay(carrier.bound) as crossed:
            with Instance("watching") as here:
                shadowing = Shadowing(system, str(crossed.endpoint), here, on_verdict=lambda verdict: None)
                async with Nursery() as nursery:
                    nursery.start(end.run(), "plant")
                    watching = nursery.start(shadowing.run(stop), "shadow")
                    await eventually(lambda: shadowing.shadow.analyze.measurements >= 40 and not end.waiting, 15)
                    stop.set()
                    await watching
        await carrier.aclose()
        await store.aclose()
        assert shadowing.shadow.digital_model.period_s == 5
        return crossed

    crossed = run(main(), timeout_s=40)
    kinds, at = [], 0
    while at < len(crossed.there):
        size = int.from_bytes(crossed.there[at : at + 2])
        said = crossed.there[at + 2 : at + 2 + size]
        if not said.startswith(WHO):  # a message of the link protocol, in which a shadow identifies itself as one
            kinds.append(said[0] & 0x0F)
        at += 2 + size
    assert set(kinds) <= {ACK, ASK, REFUSED}, "acknowledgements and questions, which ruling 16 lists"
    assert ACK in kinds
    assert len(crossed.back) > 10 * len(crossed.there) / len(kinds)


# -- 5 to 7: Monitor, Analyze, Plan, Execute ------------------------------------------------------------------------------


class Twins:
    """A digital twin by rules, and the periods that it commands."""

    def __init__(self, *rules: PlanRule, bounds: CommandLimits = CommandLimits()) -> None:  # noqa: B008
        self.receiving = ReceivingEnd("from the plant")
        self.twin = DigitalTwin(self.receiving, Hands(), RulePlanner(rules), declared=DECLARED, bounds=bounds)
        self._sent: Consumer[COMMAND] = Consumer(self.twin.execute.transmitter.event)
        self.twin.execute.transmitter.subscribe(self._sent)

    def give(self, *events: Event) -> list[int]:
        for event in events:
            self.receiving.observe("plant:1", event)
        self.twin.step()
        return [decode_period(command) for command in self._sent.drain()]


def test_prose_5_all_that_a_shadow_receives_updates_its_model_and_a_difference_is_reported() -> None:
    receiving = ReceivingEnd("from the plant")
    shadow = DigitalShadow(receiving, Hands(), declared=DECLARED)
    for event in (status(7), status(5, "OFF"), value(3.0)):
        receiving.observe("plant:1", event)
    shadow.step()
    assert shadow.digital_model.period_s == 5
    assert shadow.digital_model.variables["ctd.pressure"].value == 3.0
    assert [v.finding for v in shadow.verdicts.drain()] == ["agree", "mismatch"]


def test_prose_5_it_reuses_the_physical_twins_event_handlers_and_message_types() -> None:
    """The transmitter driver is tested in test_schema_digital_thread."""
    shadow = DigitalShadow(ReceivingEnd("from the plant"), Hands(), declared=())
    assert issubclass(SeenStatus, STATUS)
    assert issubclass(SeenMeasurement, MEASUREMENT)
    assert type(shadow.monitor.emitter) is Producer
    assert type(shadow.monitor.statuses) is type(shadow.verdicts) is Consumer  # type: ignore[comparison-overlap]


def test_prose_6_the_stages_run_one_after_another_and_each_has_the_knowledge(monkeypatch: pytest.MonkeyPatch) -> None:
    twins = Twins(PlanRule("outside", "", 1))
    twin, order = twins.twin, []
    for stage, name in (
        (twin.monitor, "handle_state"),
        (twin.monitor, "handle_measurements"),
        (twin.analyze, "compare"),
        (twin.plan, "plan_next"),
        (twin.execute, "execute"),
    ):
        real = getattr(stage, name)
        monkeypatch.setattr(stage, name, lambda s=stage, n=name, r=real: (order.append(s.name), r())[1])
    assert twins.give(value(150.0)) == [1]
    first = list(dict.fromkeys(order))
    assert [name for name in first if name != "execute"] == ["monitor", "analyze", "plan"]
    assert order.index("plan") < len(order) - order[::-1].index("execute")
    assert len({id(stage.digital_model) for stage in twin.processes}) == 1  # type: ignore[attr-defined]
    assert [event.kind for stage in twin.processes for event in stage.collect()] == [Kind.VERDICT]


def test_prose_7_what_the_model_does_not_accept_is_not_sent_and_no_user_steps_in() -> None:
    twins = Twins(PlanRule("outside", "", 1), PlanRule("inside", "", 30), bounds=CommandLimits(10, 60))
    assert twins.give(status(20), value(150.0)) == []
    assert twins.twin.digital_model.period_s == 20
    assert [e.value for e in twins.twin.execute.collect()] == ["a period of 1 s; allowed are 10 to 60 s"]
    assert twins.give(value(50.0)) == [30], "by itself"


# -- 8: the prototype's own model, and "what if" --------------------------------------------------------------------------


def test_prose_8_the_prototypes_digital_model_is_another_instance_than_the_shadows() -> None:
    prototype = DigitalTwinPrototype(*observatory(), CLOCK)
    shadow = DigitalShadow(ReceivingEnd("from the plant"), Hands(), declared=declared_variables(observatory()[0]))
    prototype.model.process_event(encode_period(5))
    prototype.model.variables.changed("ctd.pressure", 3.0, Quality.GOOD, Reason.NONE, NOW_MS)
    assert (prototype.model.period_s, shadow.digital_model.period_s) == (5, 0)
    assert not shadow.digital_model.variables["ctd.pressure"].heard


def test_prose_8_a_digital_twin_asks_a_prototype_what_if_with_the_full_software_stack() -> None:
    """The gateway, the PLC and the emulators of a run, ahead in virtual time, from the twin's knowledge."""
    stays = ("relay.state == 'ACTIVE'", "quality(ctd.pressure) == 'good'")
    known = {"ctd.pressure": 50.0}
    question = QuestionMessage(
        "observatory", 8.0, (), stays, 1.0, period_s=1, values=known, programs={"relay": of_period(3)}
    )
    assert objection(question) == ""
    stops = QuestionMessage(
        "observatory", 8.0, (), stays, 1.0, period_s=0, values=known, programs={"relay": of_period(3)}
    )
    assert "does not hold 8 s from now; at the end relay.state: 'STANDBY'" in objection(stops)


def test_prose_8_a_prototype_can_serve_as_the_digital_twin_itself() -> None:
    """It continues from the plant's state and samples as the plant does. tests/system tests it with a digital twin in CI."""
    state = KnownState({"ctd.pressure": 50.0}, {"relay": of_period(2)})
    outcome = answer(Fork("observatory", state, 10.0), WhatIfPlan("goes on"))
    assert outcome.error == ""
    assert [name for _, name in outcome.states["relay"]] == ["ACTIVE"]
    assert 3 <= outcome.variables["ctd.pressure"].good <= 6, "a sample each two seconds"


# -- 9: virtual context ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name", sorted(p.name.partition(".")[0] for p in (CHECKOUT / "profiles/systems").glob("*.prototype.yaml"))
)
def test_prose_9_virtual_context_is_recorded_data_or_a_simulation(name: str) -> None:
    system = load_system(name)
    prototype = load_prototype(system)
    for device in prototype.devices.values():
        form = device.form
        assert [form.recording, form.simulation, form.model].count(None) == 2, device.name
        if form.recording is not None:
            assert device.recording is not None
            with RecordingReader(device.recording) as recording:
                held = recording.rows() if recording.header.kind == "signals" else recording.exchanges()
                assert next(iter(held), None) is not None, "there is something in it"
        elif form.simulation is not None:
            steps = prototype.form.simulations[form.simulation]
            assert steps.formulas or steps.python, "it computes something"
        else:
            assert form.model == "mailbox" or device.profile.protocol, "what its own profile says"


def test_prose_9_a_recording_from_the_field_goes_back_into_CI(tmp_path: Path) -> None:
    """An emulator answers from the recorded traffic between the driver and a real device, in the recorded order."""
    _, stranger = run(both_talks(tmp_path))
    seen = exchanges(stranger)
    changing = bytes.fromhex("0300320001")  # a register with a different value each time
    seen += [RecordedExchange(100.0 + n, seen[0].unit, changing, bytes([3, 2, 0, n])) for n in (7, 1, 9)]
    header = RecordingHeader(version=1, device="x/modem", kind="exchanges", source="measured")
    with RecordingWriter(tmp_path / "field.jsonl", header) as writer:
        for exchange in seen:
            writer.exchange(exchange)
    with RecordingReader(tmp_path / "field.jsonl") as reader:
        unit = ReplayUnit(ExchangeReplay(reader.exchanges()), 1)
    assert [unit.respond(e.request, i) for i, e in enumerate(seen)] == [e.reply for e in seen]


# -- 10: measured figures -------------------------------------------------------------------------------------------------


def test_prose_10_fidelity_is_measured_and_printed(tmp_path: Path) -> None:
    read = bytes.fromhex("0300000001")
    for name, last in (("device", 5), ("emulator", 6)):
        header = RecordingHeader(version=1, device="x/y", kind="exchanges", source="measured")
        with RecordingWriter(tmp_path / f"{name}.jsonl", header) as writer:
            for i, word in enumerate((1, 2, 3, last)):
                writer.exchange(RecordedExchange(float(i), 1, read, bytes([3, 2, 0, word]), 0.01))
    files = [str(tmp_path / "device.jsonl"), str(tmp_path / "emulator.jsonl")]
    told = CliRunner().invoke(compare_command, files, standalone_mode=False)
    assert "fidelity: values 75.0 %, timing" in told.output
    assert told.return_value == 1


def test_prose_10_twinning_rate_and_lag_are_measured_and_printed(capsys: pytest.CaptureFixture[str]) -> None:
    clock, receiving = Hands(), ReceivingEnd("from the plant")
    shadow = DigitalShadow(receiving, clock, declared=())
    for n in range(11):
        clock.now_ms = NOW_MS + 100 * n
        receiving.observe("plant:1", status(5, t_ms=clock.now_ms - 40))
        shadow.step()
    thread = {"links": 1, "duplicates": 0, "trouble": ""}
    other = {"origins": ["plant:1"], "prototype": True, "reports_state": True, "thread": thread, "store_trouble": ""}
    print_shadow({**shadow.describe(), **other})
    assert exit_code({**shadow.describe(), **other}) == 0
    told = capsys.readouterr().err
    assert "10.0 reports a second" in told
    assert "median 40 ms" in told
    assert "11, 11 of them agree with the model" in told
    assert json.dumps(shadow.describe()), "and as JSON"
