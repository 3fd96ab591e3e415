"""`fieldtwin check` on third-party clients, each in a separate program, and on our client with its own served
registers."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[3]

PYMODBUS = """
import os, time
from pymodbus.client import ModbusSerialClient
client = ModbusSerialClient(os.environ["FIELDTWIN_TTY"], baudrate=19200, parity="N", timeout=0.15, retries=0)
client.connect()
while True:
    try:
        reply = client.read_holding_registers(0, count=2, device_id=1)
        if not reply.isError():
            print(reply.registers[0])
    except Exception as e:
        print(type(e).__name__)
        client.connect()
    time.sleep(0.02)
"""

CANOPEN = """
import os, time, canopen
from fieldtwin.gateway.connections.soft_bus import SoftBus
network = canopen.Network()
network.bus = SoftBus(channel=os.environ["FIELDTWIN_CHANNEL"])
network.connect()
node = canopen.RemoteNode(5, canopen.ObjectDictionary())
network.add_node(node)
node.sdo.RESPONSE_TIMEOUT = 0.15
while True:
    try:
        print(int.from_bytes(node.sdo.upload(0x2000, 0), "little"))
    except Exception as e:
        print(type(e).__name__)
    time.sleep(0.02)
"""

ENDS = """
import os, socket

pytestmark = pytest.mark.long
link = socket.create_connection((os.environ["FIELDTWIN_HOST"], int(os.environ["FIELDTWIN_PORT"])))
for i in range(30):
    link.sendall(bytes((0, i, 0, 0, 0, 6, 1, 3, 0, 0, 0, 1)))
    print(int.from_bytes(link.recv(100)[-2:], "big"))
raise SystemExit("I was told to")
"""


def environment() -> dict[str, str]:
    """Where programs under test find the modules of this project."""
    return {**os.environ, "PYTHONPATH": str(ROOT), "NO_COLOR": "1"}


def run_check(
    tmp_path: Path, *args: str, program: str, probe: str = "output"
) -> tuple[int, dict[str, tuple[str, str]], str]:
    """Return the exit code, (verdict, reason) by id, and the console output."""
    script = tmp_path / "client.py"
    script.write_text(program)
    done = subprocess.run(
        [
            sys.executable,
            "-m",
            "fieldtwin",
            "check",
            *args,
            "--probe",
            probe,
            "--json",
            "--patience",
            "4s",
            "--",
            sys.executable,
            str(script),
        ],
        capture_output=True,
        text=True,
        timeout=60,
        env=environment(),
        cwd=tmp_path,
        check=False,
    )
    results: list[dict[str, Any]] = json.loads(done.stdout)["cases"] if done.stdout else []
    return done.returncode, {r["id"]: (r["verdict"], r["reason"]) for r in results}, done.stderr


@pytest.mark.long
def test_pymodbus_hands_a_late_rtu_reply_to_the_next_request(tmp_path: Path) -> None:
    code, found, said = run_check(
        tmp_path, "modbus-client", "--listen", f"pty:{tmp_path}/line", "--timeout", "150ms", "--only", "13,14,16",
        "--junit", str(tmp_path / "j.xml"), program=PYMODBUS,
    )  # fmt: skip
    assert code == 1, said
    assert {id: verdict for id, (verdict, _) in found.items()} == {
        "MB-013": "failed", "MB-014": "passed", "MB-016": "failed",
    }  # fmt: skip
    assert "published 3333, the value of the bad frame" in found["MB-013"][1]
    assert "MB-013" in said, "a failure is told when it comes"
    assert "MB-016 wrong function code" in (tmp_path / "j.xml").read_text()


def test_canopens_client_takes_a_29_bit_frame_for_an_answer(tmp_path: Path) -> None:
    code, found, said = run_check(
        tmp_path, "canopen-master", "--listen", "can:fieldtwin/127.0.0.1:0", "--timeout", "150ms", "--only", "5,60",
        program=CANOPEN,
    )  # fmt: skip
    assert code == 0, "robustness does not decide the exit code"
    assert "CO-060 extended id with a CANopen number (robustness): published 3333" in said
    assert {id: verdict for id, (verdict, _) in found.items()} == {"CO-005": "passed", "CO-060": "failed"}


def test_a_program_that_never_asks_is_reported_with_its_last_output(tmp_path: Path) -> None:
    code, found, said = run_check(
        tmp_path,
        "modbus-client",
        "--listen",
        "tcp://127.0.0.1:0",
        "--only",
        "14",
        program="raise SystemExit('no licence')",
    )
    assert (code, found) == (4, {})
    assert "no licence" in said
    assert "the program ended before its first request, exit code 1" in said


@pytest.mark.parametrize(
    ("args", "says"),
    [
        (["modbus-client"], "no endpoint to listen on"),
        (["modbus-client", "--listen", "can:fieldtwin/x:1"], "the endpoint for the client or master"),
        (["modbus-client", "--listen", "tcp://127.0.0.1:0", "--only", "MB-0133"], "no case 'MB-0133'"),
        (["modbus-client", "--listen", "tcp://127.0.0.1:0", "--values", "1,2"], "three different numbers"),
        (["modbus-client", "--listen", "tcp://127.0.0.1:0", "--probe", "output"], "nothing prints"),
        (["modbus-client", "--listen", "tcp://127.0.0.1:0", "--probe", "tcp://x"], "a probe"),
        (["modbus-client", "--listen", "tcp://127.0.0.1:0", "--hold", "holding:x=1"], "--hold"),
        (["canopen-master", "--listen", "tcp://127.0.0.1:0"], "the endpoint for the client or master"),
        (["canopen-master", "--listen", "can:fieldtwin/127.0.0.1:0", "--hold", "6041=1"], "--hold"),
    ],
)
def test_bad_usage_is_reported_in_one_line(args: list[str], says: str, capsys: pytest.CaptureFixture[str]) -> None:
    from fieldtwin.cli.main import main

    before = sys.argv
    sys.argv = ["fieldtwin", "check", *args]
    try:
        with pytest.raises(SystemExit) as ended:
            main()
    finally:
        sys.argv = before
    assert ended.value.code == 2
    assert says in capsys.readouterr().err


OPENS_AGAIN = """
import os, select, termios, time
ASK = bytes.fromhex("01030000000184 0a".replace(" ", ""))
port = -1
while True:
    try:
        if port < 0:
            port = os.open(os.environ["FIELDTWIN_TTY"], os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
            termios.tcflush(port, termios.TCIOFLUSH)
        os.write(port, ASK)
        got, end = b"", time.monotonic() + 0.15
        while len(got) < 7 and (left := end - time.monotonic()) > 0:
            if select.select([port], [], [], left)[0]:
                got += os.read(port, 64)
        if len(got) == 7:
            print(int.from_bytes(got[3:5], "big"))
    except OSError:
        if port >= 0:
            os.close(port)
        port = -1
        if not %r:
            time.sleep(60)
    time.sleep(0.02)
"""


@pytest.mark.long
@pytest.mark.parametrize(("again", "verdict"), [(True, "passed"), (False, "failed")])
def test_a_port_that_is_unplugged_comes_back_under_its_name(tmp_path: Path, again: bool, verdict: str) -> None:
    code, found, said = run_check(
        tmp_path, "modbus-client", "--listen", f"pty:{tmp_path}/line", "--timeout", "150ms", "--only", "66",
        program=OPENS_AGAIN % again,
    )  # fmt: skip
    assert found["MB-066"][0] == verdict, said
    assert code == (0 if again else 1)


@pytest.mark.long
def test_a_program_that_ended_without_its_port_is_started_again_when_the_port_is_back(tmp_path: Path) -> None:
    ends = OPENS_AGAIN.replace("if not %r:\n            time.sleep(60)", "raise")
    _, found, said = run_check(
        tmp_path, "modbus-client", "--listen", f"pty:{tmp_path}/line", "--timeout", "150ms", "--only", "66,68",
        program=ends,
    )  # fmt: skip
    assert found["MB-066"][0] == "failed", said
    assert found["MB-068"][0] == "passed", said
