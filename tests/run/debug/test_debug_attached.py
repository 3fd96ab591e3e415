"""A debugger that is attached to a running prototype: stops in a scan, their effects on the simulated devices, and the end."""

from __future__ import annotations

import asyncio
import os
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from debug_editor import Editor, editor_on_socket
from shed_site import write_shed

from fieldtwin.gateway.core.control import ControlClient
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.run.debug.programs import Debuggee
from fieldtwin.run.debug.relay import attach
from fieldtwin.run.live.child_configs import run_record
from fieldtwin.run.live.options import RunOptions
from fieldtwin.run.processes.run_record import write_record
from fieldtwin.twin.plant.instance import runtime_root
from fieldtwin.twin.site.system import load_system

PROGRAM = """FUNCTION Twice : INT
VAR_INPUT x : INT; END_VAR
  Twice := 2 * x;
END_FUNCTION
PROGRAM idle
  VAR_INPUT level : REAL; END_VAR
  VAR_OUTPUT valve : INT := 1; END_VAR
  VAR n, seen : INT; delay : TON; END_VAR
  n := (n + 1) MOD 30000;
  delay(IN := TRUE, PT := T#1h);
  seen := Twice(n);
  valve := 1;
END_PROGRAM
"""
ADDS = 9
Ask = Callable[..., dict[str, Any]]


@pytest.fixture
def shed(tmp_path: Path) -> Path:
    write_shed(tmp_path)
    system = (tmp_path / "shed.yaml").read_text()
    system = system.replace("writable: [valve]", "writable: [valve], safe: {valve: 0}")
    (tmp_path / "shed.yaml").write_text(
        system.replace("if_bad: hold}}}", "if_bad: hold}}, outputs: {valve: tank.valve}}")
    )
    (tmp_path / "idle.st").write_text(PROGRAM)
    return tmp_path


@pytest.fixture
def ask(shed: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Iterator[Ask]:
    """Run the prototype, and return what sends a command to its PLC."""
    folder = tmp_path_factory.mktemp("r")
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(folder))
    line = [sys.executable, "-m", "fieldtwin", "run", "shed.yaml", "--prototype", "--for", "120s"]
    env = {**os.environ, "NO_COLOR": "1"}
    with subprocess.Popen(
        line, cwd=shed, env=env, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    ) as process:
        assert process.stdout is not None
        printed = []
        for text in process.stdout:
            printed.append(text)
            if "→" in text:
                (shed / "port").write_text(text.rpartition(":")[2].strip())
            if text.startswith("t="):
                break
        socks = list(folder.glob("**/plc.sock"))
        assert len(socks) == 1, "".join(printed)

        async def call(command: str, args: dict[str, Any]) -> dict[str, Any]:
            client = await ControlClient.connect_unix(socks[0])
            try:
                found: dict[str, Any] = await client.call(command, **args)
                return found
            finally:
                await client.aclose()

        yield lambda command, **args: asyncio.run(call(command, args))
        process.terminate()


@pytest.fixture
def editor(ask: Ask) -> Iterator[Editor]:
    def no_launch(_: dict[str, Any]) -> Debuggee:
        raise AssertionError("nothing is launched")

    with editor_on_socket(no_launch) as one:
        yield one


def holds(condition: Callable[[], bool]) -> None:
    """Wait until a condition holds."""
    until = time.monotonic() + 20
    while not condition():
        assert time.monotonic() < until
        time.sleep(0.02)


def tag(ask: Ask, name: str) -> dict[str, Any]:
    rows: list[dict[str, Any]] = ask("image", tags=[name])["tags"]
    return rows[-1]


def valve(shed: Path) -> int:
    """Return the register of the emulated valve, read from the device over Modbus TCP."""
    port = int((shed / "port").read_text())
    with socket.create_connection(("127.0.0.1", port), timeout=5) as device:
        device.sendall(struct.pack(">HHHBBHH", 1, 0, 6, 1, 3, 0, 1))
        return int.from_bytes(device.recv(64)[-2:])


def test_a_stopped_scan_makes_the_outputs_safe_and_goes_on(editor: Editor, shed: Path, ask: Ask) -> None:
    editor.begin({shed / "idle.st": [ADDS]}, "attach", instance="shed")
    assert editor.wait("stopped")["reason"] == "breakpoint"
    assert editor.place() == ("idle", ADDS)
    brief = ask("get", brief=True)
    assert brief["debugger"].endswith(f"idle.st:{ADDS}; the outputs are safe")
    for name in ("idle.n", "tank.level"):  # an output and an input of the programs
        assert (tag(ask, name)["quality"], tag(ask, name)["reason"]) == ("bad", "not operational")
    holds(lambda: valve(shed) == 0)  # the gateway has written the safe value
    n = int(editor.value("n"))
    editor.goes_on("next")
    editor.goes_on("next")
    editor.goes_on("stepIn")
    assert editor.place() == ("Twice", 3)
    editor.goes_on("stepOut")
    assert [editor.value(one) for one in ("n", "seen", "n * 2")] == [str(n + 1), str(2 * n + 2), str(2 * n + 2)]
    editor.ask("setExpression", expression="n", value="29000", frameId=1)
    editor.goes_on()
    assert editor.value("n") == "29000"
    assert (
        tag(ask, "idle.n")["quality"] == "bad"
    )  # also between the two stops, because the inputs of the first scan are old
    editor.breakpoints(shed / "idle.st")
    editor.ask("continue", threadId=1)
    holds(lambda: tag(ask, "idle.n")["quality"] == "good" and valve(shed) == 1)
    after = ask("get", brief=True)
    assert (after["state"], after["restarts"], after["acts"]["debug"], after["acts"]["debug_set"]) == (
        "running",
        0,
        1,
        1,
    )


def test_logpoints_and_conditions_do_not_disturb_a_running_plc(editor: Editor, shed: Path, ask: Ask) -> None:
    before = ask("get", brief=True)["restarts"]
    editor.begin(
        {shed / "idle.st": [{"line": ADDS + 2, "logMessage": "n is {n}", "condition": "n MOD 10 = 0"}]}, "attach"
    )
    numbers = [int(editor.logged().rpartition(" ")[2]) for _ in range(3)]
    assert [b - a for a, b in pairwise(numbers)] == [10, 10]
    assert tag(ask, "idle.n")["quality"] == "good"
    assert ask("get", brief=True)["restarts"] == before


def test_the_watchdogs_do_not_end_a_stopped_scan(editor: Editor, shed: Path, ask: Ask) -> None:
    editor.begin({shed / "idle.st": [ADDS]}, "attach")
    editor.wait("stopped")
    since = int(editor.value("n"))
    for n in range(1, 8):  # each of these scans is an overrun without a debugger, and three in a row stop the task
        editor.goes_on()
        assert int(editor.value("n")) == since + n
    with pytest.raises(Exception, match="a restart while a debugger has stopped a scan"):
        ask("restart", cold=False, by="test")
    editor.ask("disconnect")
    holds(lambda: tag(ask, "idle.n")["quality"] == "good")
    after = ask("get", brief=True)
    assert (after["state"], after["restarts"], after["debugger"]) == ("running", 0, "")
    assert after["overruns"] < 3  # a busy host may cause some, but stopped scans do not


def test_no_debugger_attaches_to_a_run_that_can_write_to_real_devices(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    run_dir = runtime_root() / "plant"
    run_dir.mkdir(parents=True)
    (run_dir / "plc.sock").touch()
    system = load_system("observatory")
    for options in (RunOptions("", prototype=False), RunOptions("", prototype=True, allow_writes=True)):
        write_record(run_dir, run_record(options, system, None, 0, 0))
        with pytest.raises(UsageError, match="its plant is not simulated"):
            attach("plant", lambda *_, **__: None)


def test_a_client_that_goes_loses_its_session_and_the_plc_goes_on(shed: Path, ask: Ask) -> None:
    number = ask("debug", attach=True, by="gone")["number"]
    point = {"source": {"path": str(shed / "idle.st")}, "breakpoints": [{"line": ADDS}]}
    ask("debug", number=number, requests=[{"seq": 1, "command": "setBreakpoints", "arguments": point}])
    with pytest.raises(Exception, match="another debugger is attached; got gone"):
        ask("debug", attach=True, by="second")
    holds(lambda: "stopped at" in ask("get", brief=True)["debugger"])
    holds(lambda: ask("get", brief=True)["debugger"] == "" and tag(ask, "idle.n")["quality"] == "good")
    with pytest.raises(Exception, match="there is no such debugging session"):
        ask("debug", number=number, requests=[])


def test_outputs_of_a_stopped_scan_stay_safe_while_the_plc_is_paused(editor: Editor, shed: Path, ask: Ask) -> None:
    editor.begin({shed / "idle.st": [ADDS]}, "attach")
    editor.wait("stopped")
    holds(lambda: valve(shed) == 0)
    ask("pause", by="test")
    editor.breakpoints(shed / "idle.st")
    editor.ask("continue", threadId=1)
    holds(lambda: "until a scan without a stop" in ask("get", brief=True)["debugger"])
    editor.ask("disconnect")
    holds(lambda: ask("get", brief=True)["debugger"].startswith("detached; the outputs are safe"))
    before = tag(ask, "idle.n")["time"]
    holds(lambda: tag(ask, "idle.n")["time"] != before)  # the paused PLC has published again
    assert (tag(ask, "idle.n")["quality"], valve(shed)) == ("bad", 0)
    ask("step", count=1, by="test")
    holds(lambda: tag(ask, "idle.n")["quality"] == "good" and valve(shed) == 1)
    assert ask("get", brief=True)["debugger"] == ""
