"""A verdict about a client comes with the frames that support it, and with a command that repeats the case.

Defects: results had no frames, ``--only`` of the reproduce line came after ``--`` and was passed to the driver, and the
aborts of canopen-python, whose multiplexer is 0, were shown as aborts of no transfer.
"""

from __future__ import annotations

import json
import shlex
import subprocess
import sys
from collections import Counter
from pathlib import Path
from xml.etree import ElementTree as ET

import pytest
from test_third_party_clients_judged import CANOPEN, environment

from fieldtwin.capture.decoding.canopen_bus import CanopenBusDecoder
from fieldtwin.conformance.core.evidence import reproduce
from fieldtwin.gateway.core.canframe import CanFrame

TAKES_ALL = """
import os, socket, sys
assert sys.argv[1:] == ["--only", "mine"], sys.argv
link = socket.create_connection((os.environ["FIELDTWIN_HOST"], int(os.environ["FIELDTWIN_PORT"])))
link.settimeout(1)
number = 0
while True:
    number += 1
    link.sendall(bytes((number >> 8 & 255, number & 255, 0, 0, 0, 6, 1, 3, 0, 0, 0, 1)))
    try:
        print(int.from_bytes(link.recv(100)[-2:], "big"), flush=True)
    except TimeoutError:
        print("no reply", flush=True)
"""


def _run(words: list[str], folder: Path) -> subprocess.CompletedProcess[str]:
    argv = [sys.executable, "-m", "fieldtwin", *words]
    return subprocess.run(argv, capture_output=True, text=True, timeout=120, env=environment(), cwd=folder, check=False)


@pytest.mark.long
def test_frames_are_in_every_file_and_the_reproduce_line_works(tmp_path: Path) -> None:
    (tmp_path / "client.py").write_text(TAKES_ALL)
    words = [
        "check",
        "modbus-client",
        "--listen",
        "tcp://127.0.0.1:0",
        "--timeout",
        "1s",
        "--probe",
        "output",
        "--only",
        "14,56a",
    ]
    words += ["--junit", "j.xml", "--html", "r.html", "-o", "r.json", "--log", "w.jsonl", "--json"]
    done = _run([*words, "--", sys.executable, "client.py", "--only", "mine"], tmp_path)
    assert done.returncode == 1, done.stderr
    document = json.loads(done.stdout)
    assert json.loads((tmp_path / "r.json").read_text()) == document
    assert (document["kind"], document["version"]) == ("fieldtwin check-client", 1)
    about = document["about"]
    assert (about["protocol"], about["endpoint"], about["at_most"]) == ("modbus", "tcp://127.0.0.1:0", "disrupt")
    assert about["command"].startswith("fieldtwin check modbus-client")
    results = {case["id"]: case for case in document["cases"]}
    assert document["counts"] == dict(Counter(case["verdict"] for case in results.values()))
    case = results["MB-056a"]
    assert case["verdict"] == "failed", case
    device = [line["data"] for line in case["wire"] if line["by"] == "device"]
    client = [line["data"] for line in case["wire"] if line["by"] == "client"]
    poisoned = next(data for data in device if data.endswith("0d 05"))
    assert any(data.endswith("00 00 00 06 01 03 00 00 00 01") for data in client)
    assert any(line["text"] == "published 3333 (poison)" for line in case["wire"])
    failure = next(
        f
        for c in ET.parse(tmp_path / "j.xml").iter("testcase")
        if "MB-056a" in c.attrib["name"]
        for f in c.iter("failure")
    )
    assert poisoned in str(failure.text)
    assert poisoned in (tmp_path / "r.html").read_text()
    log = [json.loads(line) for line in (tmp_path / "w.jsonl").read_text().splitlines()]
    assert poisoned.replace(" ", "") in [line["hex"] for line in log if line.get("direction") == "received"]
    assert {line["direction"] for line in log[1:]} == {"sent", "received"}
    program, *again = shlex.split(case["reproduce"])
    assert program == "fieldtwin"
    assert f"reproduce: {case['reproduce']}" in str(failure.text)
    once_more = _run(again, tmp_path)
    assert once_more.returncode == 1, once_more.stderr
    assert [(c["id"], c["verdict"]) for c in json.loads(once_more.stdout)["cases"]] == [("MB-056a", "failed")]


@pytest.mark.parametrize(
    ("argv", "line"),
    [
        (
            "check modbus-client --listen x -- my_driver --only 3",
            "fieldtwin check modbus-client --only MB-013 --listen x -- my_driver --only 3",
        ),
        ("check modbus-client --only 13,14 --listen x", "fieldtwin check modbus-client --only MB-013 --listen x"),
        (
            "check modbus-client --only=13 --listen x -- d",
            "fieldtwin check modbus-client --only MB-013 --listen x -- d",
        ),
    ],
)
def test_the_reproduce_line_names_the_case_before_the_program(argv: str, line: str) -> None:
    assert reproduce(shlex.split(argv), "MB-013") == line


def test_canopens_aborts_are_decoded_in_the_evidence(tmp_path: Path) -> None:
    (tmp_path / "client.py").write_text(CANOPEN)
    words = [
        "check",
        "canopen-master",
        "--listen",
        "can:fieldtwin/127.0.0.1:0",
        "--timeout",
        "150ms",
        "--probe",
        "output",
    ]
    done = _run([*words, "--only", "1", "--json", "--", sys.executable, "client.py"], tmp_path)
    (case,) = json.loads(done.stdout)["cases"]
    texts = [line["text"] for line in case["wire"] if line["data"].startswith("605#80")]
    assert texts, case
    assert any("SDO abort 05030000h" in text and "multiplexer 0" in text for text in texts), texts


def test_an_abort_of_a_client_that_names_no_object_ends_the_open_transfer() -> None:
    wire = CanopenBusDecoder("can0", [])
    done = []
    for t_ns, (number, data) in enumerate(
        [(0x605, "4000200000000000"), (0x585, "410020000a000000"), (0x605, "8000000000000305")]
    ):
        done += wire.feed(CanFrame(number, bytes.fromhex(data)), t_ns)[1]
    assert [(e.problem, e.abort) for e in done] == [("abort", 0x05030000)]
    assert "by the master" in done[0].reply_text
    assert wire.pending() == []


GIVES_UP_ITS_PORT = """
import os, time
port = os.open(os.environ["FIELDTWIN_TTY"], os.O_RDWR | os.O_NOCTTY)
import select, tty
tty.setraw(port)
while True:
    try:
        os.write(port, bytes.fromhex("010300000001840a"))
        got = b""
        while len(got) < 7 and select.select([port], [], [], 0.15)[0]:
            got += os.read(port, 64)
        if len(got) == 7:
            print(int.from_bytes(got[3:5], "big"), flush=True)
    except OSError:
        time.sleep(60)
    time.sleep(0.02)
"""


@pytest.mark.long
def test_a_port_that_the_case_releases_is_not_a_connection_of_the_client(tmp_path: Path) -> None:
    """Defect: the evidence said that the client opened a connection, but the reason said that the client sent nothing
    any more."""
    (tmp_path / "client.py").write_text(GIVES_UP_ITS_PORT)
    words = ["check", "modbus-client", "--listen", f"pty:{tmp_path}/line", "--timeout", "150ms", "--only", "66"]
    words += ["--probe", "output", "--patience", "3s", "--json", "--", sys.executable, "client.py"]
    (result,) = json.loads(_run(words, tmp_path).stdout)["cases"]
    assert (result["verdict"], "it has stopped" in result["reason"]) == ("failed", True), result
    assert [(line["by"], line["text"]) for line in result["wire"] if line["text"]] == [
        ("device", "closes connection 1"),
        ("device", "gives the port back"),
    ]
