"""A PLC as a separate process on a mapped image: commands in, outputs out, a gateway that dies, logic that raises."""

from __future__ import annotations

import asyncio
import json
import mmap
import os
import random
import signal
import sys
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from typing import Any

import pytest
from support import eventually, run

from fieldtwin.gateway.core.control import ControlClient, RemoteError
from fieldtwin.gateway.core.errors import FileInvalid, Unreachable
from fieldtwin.gateway.core.image.image import INPUTS, OUTPUTS, RegionReader, TagKind, TagSpec, message_tag, taken_name
from fieldtwin.gateway.core.statemachine import encode_period
from fieldtwin.gateway.core.values import Quality, TagValue
from fieldtwin.plc.binding import InputBinding, image_for
from fieldtwin.plc.runtime.config import PlcConfig, ProgramConfig
from fieldtwin.plc.runtime.process import plc_main

PLANT = {
    "modem.inbox": message_tag("modem.inbox", 64, 8),
    "modem.outbox": message_tag("modem.outbox", 64, 8),
    "ctd.sample": message_tag("ctd.sample", 64, 8),
    "ctd.sample_period_s": TagSpec("ctd.sample_period_s", TagKind.INT, "s"),
}
RELAY = ProgramConfig(
    "relay",
    "python: fieldtwin.plc.relay:Relay",
    {"command": InputBinding("modem.inbox"), "sample": InputBinding("ctd.sample")},
    {"period_s": "ctd.sample_period_s", "response": "modem.outbox"},
)
FAULTY = """
from fieldtwin.gateway.core.image.image import TagKind
from fieldtwin.plc.program import Program, var_input, var_output


class Faulty(Program):
    n = var_input(TagKind.INT)
    out = var_output(TagKind.INT, initial=1)

    def execute(self, scan):
        if scan.number == 5:
            raise ValueError("five")
"""


class Gateway:
    """The test as the gateway: writes INPUTS, reads OUTPUTS."""

    def __init__(self, path: Path, config: PlcConfig) -> None:
        layout = config.image_layout()
        with path.open("xb") as file:
            file.truncate(layout.size)
        with path.open("r+b") as file:
            self._mapped = mmap.mmap(file.fileno(), 0)
        self._memory = memoryview(self._mapped)
        layout.format(self._memory)
        self._image = layout.attach(self._memory)
        self._writer = self._image.writer(INPUTS)
        self.reader: RegionReader = self._image.reader(OUTPUTS)
        self.names = [tag.name for tag in layout.regions[0].tags]
        self.taken = 0
        self.arrived: list[bytes] = []

    def publish(self, **messages: bytes) -> None:
        now_ns = time.monotonic_ns()
        values = {taken_name("modem.outbox"): self.taken}
        row = [TagValue(values.get(name, 0), Quality.GOOD, t_ns=now_ns) for name in self.names]
        self._writer.publish(row, now_ns, {k.replace("_", ".", 1): [(now_ns, v)] for k, v in messages.items()})

    def take(self) -> None:
        for message in self.reader.snapshot().messages.get("modem.outbox", ()):
            self.arrived.append(message.data)
            self.taken = message.seq

    async def alive(self) -> None:
        while True:
            self.publish()
            self.take()
            await asyncio.sleep(0.02)

    def close(self) -> None:
        self._image.release()
        self._memory.release()
        self._mapped.close()


def config_in(folder: Path, *programs: ProgramConfig, **more: Any) -> PlcConfig:
    bound = [p.bind((str(folder),)) for p in programs]
    return PlcConfig(
        image_path=str(folder / "image"),
        layout=image_for(bound, PLANT).describe(),
        control_path=str(folder / "plc.sock"),
        programs=programs,
        stop_after=0,  # the test machine is busy
        heartbeat_limit_ms=300,
        priority=0,
        python_path=(str(folder),),
        **more,
    )


@asynccontextmanager
async def plc_running(config: PlcConfig) -> AsyncIterator[tuple[asyncio.subprocess.Process, Gateway, ControlClient]]:
    folder = Path(config.image_path).parent
    gateway = Gateway(Path(config.image_path), config)
    gateway.publish()
    (folder / "plc.json").write_bytes(config.to_json())
    child = await asyncio.create_subprocess_exec(sys.executable, "-m", "fieldtwin.plc", str(folder / "plc.json"))
    client = None
    try:
        client = await _connect(Path(config.control_path), child)
        assert (await client.call("ready"))["ready"] is True
        yield child, gateway, client
    finally:
        if client is not None:
            await client.aclose()
        if child.returncode is None:
            child.kill()
        await child.wait()
        gateway.close()


async def _connect(path: Path, child: asyncio.subprocess.Process) -> ControlClient:
    while True:
        try:
            return await ControlClient.connect_unix(path)
        except Unreachable:
            assert child.returncode is None
            await asyncio.sleep(0.01)


async def got(client: ControlClient, condition: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
    """Send `get` until `condition` holds for its answer."""
    last: dict[str, Any] = {}

    async def holds() -> bool:
        last.clear()
        last.update(await client.call("get"))
        return condition(last)

    await eventually(holds)
    return last


def test_commands_become_outputs_and_samples_responses_until_the_stop(tmp_path: Path) -> None:
    async def main() -> None:
        async with plc_running(config_in(tmp_path, RELAY)) as (child, gateway, client):
            beating = asyncio.create_task(gateway.alive())
            await got(client, lambda s: s["gateway_alive"] and s["variables"]["relay.state"] == 0)
            gateway.publish(modem_inbox=encode_period(2).data)
            await eventually(lambda: gateway.reader.snapshot().value("ctd.sample_period_s").value == 2)
            for n in range(20):  # more than the depth of the ring
                gateway.publish(ctd_sample=bytes([n, 0xFF]))
                await eventually(lambda n=n: len(gateway.arrived) > n)
            assert gateway.arrived == [bytes([n, 0xFF]) for n in range(20)]
            gateway.publish(modem_inbox=b"nonsense")
            status = await got(client, lambda s: s["variables"]["relay.bad_commands"] == 1)
            assert status["variables"]["relay.state"] == 1
            assert status["variables"]["relay.period_s"] == 2
            assert (status["state"], status["error"]) == ("running", "")
            assert status["inputs"]["modem.inbox"]["quality"] == "good"
            assert status["lateness_us"]["count"] >= status["scans"] > 0
            assert status["realtime"]["refused"]["SCHED_FIFO 0"] == "not requested"
            with pytest.raises(RemoteError):
                await client.call("fault")
            assert (await client.call("stop"))["state"] == "stopped"
            assert gateway.reader.snapshot().stopped
            assert await asyncio.wait_for(child.wait(), 1.0) == 0
            assert not (tmp_path / "plc.sock").exists()
            beating.cancel()
            await asyncio.wait([beating])

    run(main())


def test_a_gateway_that_dies_turns_inputs_bad_and_sigterm_ends_it_within_a_second(tmp_path: Path) -> None:
    async def main() -> None:
        async with plc_running(config_in(tmp_path, RELAY, cycle_ms=5_000)) as (child, gateway, _):
            child.send_signal(signal.SIGTERM)  # in the middle of a long cycle
            assert await asyncio.wait_for(child.wait(), 1.0) == 0
            assert gateway.reader.snapshot().stopped
        os.unlink(tmp_path / "image")
        async with plc_running(config_in(tmp_path, RELAY, cycle_ms=2)) as (child, gateway, client):
            beating = asyncio.create_task(gateway.alive())
            await got(client, lambda s: s["gateway_alive"])
            beating.cancel()
            status = await got(client, lambda s: not s["gateway_alive"])
            assert {(v["quality"], v["reason"]) for v in status["inputs"].values()} == {("bad", "gateway dead")}
            scans = status["scans"]
            await got(client, lambda s: s["scans"] > scans)  # and it continues to scan
            gateway.publish()
            await got(client, lambda s: s["inputs"]["ctd.sample"]["quality"] == "good")
            child.send_signal(signal.SIGINT)
            assert await asyncio.wait_for(child.wait(), 1.0) == 0

    run(main())


def test_a_killed_plc_leaves_a_consistent_image_and_its_successor_continues(tmp_path: Path) -> None:
    async def main() -> None:
        config = config_in(tmp_path, RELAY, cycle_ms=1)
        async with plc_running(config) as (child, gateway, _):
            gateway.publish(modem_inbox=encode_period(3).data)
            await eventually(lambda: gateway.reader.snapshot().value("ctd.sample_period_s").value == 3)
            child.kill()
            await child.wait()
            last = gateway.reader.snapshot()
            assert not last.stopped  # no process could report it: the heartbeat stands still
            again = await asyncio.create_subprocess_exec(
                sys.executable, "-m", "fieldtwin.plc", str(tmp_path / "plc.json")
            )
            try:
                await eventually(lambda: gateway.reader.snapshot().counter > last.counter)
                out = gateway.reader.snapshot()
                assert out.value("relay.commands").value == 0  # the old command is not executed again
                assert out.value("modem.inbox.consumed").value == 1
            finally:
                again.terminate()
                assert await asyncio.wait_for(again.wait(), 1.0) == 0

    run(main())


def test_logic_that_raises_stops_with_outputs_safe_and_can_be_asked_why(tmp_path: Path) -> None:
    (tmp_path / "faulty_program.py").write_text(FAULTY)
    line = FAULTY.splitlines().index('            raise ValueError("five")') + 1

    async def main() -> None:
        program = ProgramConfig("f", "python: faulty_program:Faulty", {"n": InputBinding("ctd.sample_period_s")})
        async with plc_running(config_in(tmp_path, program)) as (child, gateway, client):
            gateway.publish()
            status = await got(client, lambda s: s["state"] == "stopped")
            assert status["stop_reason"] == "failed"
            assert f"program f, faulty_program.py:{line}: ValueError: five" in status["error"]
            out = gateway.reader.snapshot()
            assert out.stopped
            assert out.value("f.out").quality is Quality.BAD
            child.terminate()
            assert await asyncio.wait_for(child.wait(), 1.0) == 1

    run(main())


STUCK = """
from fieldtwin.gateway.core.image.image import TagKind
from fieldtwin.plc.program import Program, var_local, var_retain


class Endless(Program):
    count = var_local(TagKind.INT, initial=0)
    runs = var_retain(TagKind.INT, initial=0)

    def execute(self, scan):
        self.count += 1
        self.runs += scan.first_scan
        while self.runs == 1 and scan.number == 3:
            try:
                sum(range(100))
            except Exception:
                pass
"""


def test_a_scan_that_does_not_end_is_ended_with_outputs_safe_and_the_programs_begin_again(tmp_path: Path) -> None:
    (tmp_path / "endless_program.py").write_text(STUCK)

    async def main() -> None:
        program = ProgramConfig("e", "python: endless_program:Endless")
        more = {"stuck_ms": 50.0, "restart_after_ms": 300.0, "retain_path": str(tmp_path / "retain")}
        async with plc_running(config_in(tmp_path, program, **more)) as (child, gateway, client):
            await eventually(lambda: gateway.reader.snapshot().stopped)
            status = await got(client, lambda s: s["stop_reason"] == "stuck")
            assert "program e" in status["error"]
            assert "endless_program.py" in status["error"]
            assert "the scan did not end: 50 ms" in status["error"]
            status = await got(client, lambda s: s["restarts"] == 1 and s["scans"] > 5)
            assert (status["state"], status["retain"]["start"]) == ("running", "warm start")
            assert status["stops"]["count"] == 1
            assert "the scan did not end: 50 ms" in status["stops"]["last"]
            assert status["variables"]["e.runs"] == 2
            assert not gateway.reader.snapshot().stopped
            await client.call("stop")
            assert await asyncio.wait_for(child.wait(), 1.0) == 0

    run(main())


def test_forces_pause_steps_and_reasons_over_the_control_channel(tmp_path: Path) -> None:
    async def main() -> None:
        config = config_in(tmp_path, RELAY, cycle_ms=2, audit_path=str(tmp_path / "audit"))
        async with plc_running(config) as (_, gateway, client):
            gateway.publish(modem_inbox=encode_period(4).data)
            await eventually(lambda: gateway.reader.snapshot().value("ctd.sample_period_s").value == 4)
            [why] = (await client.call("why", tag="ctd.sample_period_s"))["changes"][:1]
            assert (why["program"], why["before"], why["after"]) == ("relay", 0, 4)
            await client.call("force", tag="ctd.sample_period_s", value=9, by="test")
            await eventually(lambda: gateway.reader.snapshot().value("ctd.sample_period_s").value == 9)
            assert gateway.reader.snapshot().value("ctd.sample_period_s").quality is Quality.SIMULATED
            assert (await client.call("get"))["forces"]["ctd.sample_period_s"]["by"] == "test"
            assert "relay.state" in (await client.call("image"))["names"]
            [commanded] = (await client.call("image", tags=["ctd.sample_period_s"]))["tags"]
            assert (commanded["quality"], commanded["forced"]["by"]) == ("simulated", "test")
            with pytest.raises(RemoteError, match="which tags"):
                await client.call("image", tags="ctd.*")
            with pytest.raises(RemoteError, match=r"no tag or variable 'no\.such'"):
                await client.call("image", tags=["no.such"])
            assert "outputs" not in await client.call("get", brief=True)
            for args in ({"tag": "no.such", "value": 1}, {"value": 1}, {"tag": "ctd.sample_period_s", "value": "x"}):
                with pytest.raises(RemoteError):
                    await client.call("force", **args)
            with pytest.raises(RemoteError, match="not forced"):
                await client.call("unforce", tag="relay.state")
            await client.call("unforce", all=True)
            with pytest.raises(RemoteError, match="paused"):
                await client.call("step", count=1)
            await client.call("pause")
            scans = (await got(client, lambda s: s["state"] == "paused"))["scans"]
            await client.call("step", count=3)
            status = await got(client, lambda s: s["scans"] == scans + 3)
            assert status["state"] == "paused"
            counter = gateway.reader.snapshot().counter
            await eventually(lambda: gateway.reader.snapshot().counter > counter + 3)  # outputs are still published
            assert (await client.call("get"))["scans"] == scans + 3
            await client.call("go")
            await got(client, lambda s: s["scans"] > scans + 3)
            assert (await client.call("restart", cold=True))["start"]
            await got(client, lambda s: s["restarts"] == 1 and s["variables"]["relay.commands"] == 0)
            assert (await client.call("get"))["acts"]["force"] == 1

    run(main())
    noted = [json.loads(line) for line in (tmp_path / "audit").read_text().splitlines()]
    assert [n["action"] for n in noted] == ["force", "refuse", "refuse", "unforce", "pause", "step", "go", "restart"]
    assert (noted[0]["by"], noted[0]["old"], noted[0]["new"], noted[3]["old"]) == ("test", 4, 9, 9)


def test_the_configuration_survives_json_and_a_wrong_one_is_refused(tmp_path: Path) -> None:
    config = config_in(tmp_path, RELAY, cycle_ms=2.5)
    assert PlcConfig.from_json(config.to_json()) == config
    text = json.loads(config.to_json())
    text["cycle_ms"] = "fast"
    with pytest.raises(FileInvalid, match="cycle_ms"):
        PlcConfig.from_json(json.dumps(text).encode())
    with pytest.raises(FileInvalid, match="cannot read"):
        PlcConfig.load(tmp_path / "nothing.json")


def test_a_missing_empty_or_foreign_image_is_refused(tmp_path: Path) -> None:
    config = config_in(tmp_path, RELAY)
    with pytest.raises(Unreachable, match="no process image"):
        plc_main(config)
    (tmp_path / "image").write_bytes(b"")
    with pytest.raises(FileInvalid, match="not a process image"):
        plc_main(config)
    (tmp_path / "image").write_bytes(bytes(config.image_layout().size))
    with pytest.raises(FileInvalid, match="not a process image"):
        plc_main(config)


ROUNDS = 6


@pytest.mark.long
@pytest.mark.timeout(240)
def test_retained_variables_survive_a_kill_after_or_during_a_change_of_them(tmp_path: Path) -> None:
    """Each round: the program gets a retained variable or loses it, and the process is killed during the change or after it."""
    counting = "PROGRAM p VAR RETAIN kept : DINT;{} END_VAR kept := kept + 1;{} END_PROGRAM"
    versions = [counting.format("", ""), counting.format(" more : DINT := 1000;", " more := more + 1;")]
    source = tmp_path / "count.st"
    program, chance = ProgramConfig("p", "count.st"), random.Random(1)
    source.write_text(versions[0])

    async def main() -> None:
        kept = more = 0
        for number in range(1, ROUNDS + 1):
            (tmp_path / "image").unlink(missing_ok=True)
            (tmp_path / "plc.sock").unlink(missing_ok=True)
            config = config_in(tmp_path, program, cycle_ms=2, retain_path=str(tmp_path / "retain"))
            async with plc_running(config) as (child, _, client):
                status = await got(client, lambda s: s["state"] == "running" and s["scans"] > 0)
                start = status["retain"]["start"]
                assert start == "cold start" if number == 1 else start.startswith("warm start"), (number, start)
                assert start == "warm start" or number % 3 == 1, (
                    "the whole file is valid unless the change was not complete"
                )
                assert (await client.call("get"))["retained"]["p"]["kept"] > kept
                now = (await got(client, lambda s: s["scans"] > 20))["retained"]["p"]
                assert now.get("more", more) >= more, number
                source.write_text(versions[number % 2])
                prepared = await client.call("prepare_change", 60.0)
                applied = asyncio.create_task(client.call("apply_change", number=prepared["number"]))
                if number % 3:
                    await applied
                    now = (await got(client, lambda s: s["changes"]["count"] == 1))["retained"]["p"]
                else:
                    await asyncio.sleep(chance.random() / 500)
                kept, more = now["kept"], now.get("more", 0)
                child.kill()
                await child.wait()
                with suppress(RemoteError, Unreachable):
                    await applied

    run(main(), 230)
