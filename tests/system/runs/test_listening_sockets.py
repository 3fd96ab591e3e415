"""Listening sockets of each mode: each is started, and the sockets of its processes are read from /proc.

SECURITY.md has the same facts as a table. No process may listen beyond loopback without a request, and then only with a token.
"""

from __future__ import annotations

import json
import os
import re
import socket
import stat
import struct
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from modbus_pki import make_pki
from procs import CHECKOUT, Asking, alive, fieldtwin, free_port, run_to_end, wait_for

pytestmark = pytest.mark.timeout(180)
LISTENING = "0A"
LOOPBACK = "127.0.0.1"


def tree(pid: int) -> set[int]:
    """Return the process and its descendants."""
    found = {pid}
    for task in Path(f"/proc/{pid}/task").glob("*/children"):
        for child in task.read_text().split():
            found |= tree(int(child))
    return found


def inodes(pids: set[int]) -> set[str]:
    found = set()
    for pid in pids:
        for fd in Path(f"/proc/{pid}/fd").glob("*"):
            try:
                target = os.readlink(fd)
            except OSError:  # closed meanwhile
                continue
            if target.startswith("socket:["):
                found.add(target[8:-1])
    return found


def listening(pid: int) -> set[tuple[str, int]]:
    """Return address and port of each TCP socket on which the process or a descendant listens; of UDP, each bound one."""
    ours, found = inodes(tree(pid)), set()
    for table, states in (("tcp", {LISTENING}), ("tcp6", {LISTENING}), ("udp", {"07"}), ("udp6", {"07"})):
        for line in Path(f"/proc/{pid}/net/{table}").read_text().splitlines()[1:]:
            words = line.split()
            if words[9] in ours and words[3] in states:
                host, _, port = words[1].partition(":")
                packed = b"".join(struct.pack("=I", int(host[at : at + 8], 16)) for at in range(0, len(host), 8))
                family = socket.AF_INET if len(packed) == 4 else socket.AF_INET6
                found.add((socket.inet_ntop(family, packed), int(port, 16)))
    return found


def only_loopback(pid: int) -> set[int]:
    """Return the ports; fail if one of them is not on 127.0.0.1."""
    found = listening(pid)
    assert {host for host, _ in found} <= {LOOPBACK}, found
    return {port for _, port in found}


@pytest.mark.long
def test_a_prototype_listens_on_loopback_and_its_channels_are_the_owners(tmp_path: Path) -> None:
    metrics, thread = free_port(), free_port()
    told = ("--metrics", str(metrics), "--thread", f"tcp://127.0.0.1:{thread}")
    with fieldtwin(tmp_path, "run", "observatory", "--prototype", "--json", "--commands", "none", *told) as run:
        socket_of_gateway = tmp_path / "observatory" / "gateway.sock"
        wait_for(
            lambda: socket_of_gateway.exists() or run.process.poll() is not None, 60, "the gateway's control channel"
        )
        gateway = run.control("observatory", "gateway")
        run.control("observatory", "plc")
        wait_for(lambda: all(d["online"] for d in gateway("get")["devices"].values()), 40, "every device online")
        wait_for(lambda: {metrics, thread} <= only_loopback(run.process.pid), 20, "metrics and thread")
        # The CAN bus, the modem, its remote end and the serve section of the system file, in addition to metrics and thread.
        assert len(only_loopback(run.process.pid)) == 6
        folder = tmp_path / "observatory"
        assert stat.S_IMODE(folder.stat().st_mode) == 0o700
        channels = {path.name: stat.S_IMODE(path.stat().st_mode) for path in folder.glob("*.sock")}
        assert {"gateway.sock", "plc.sock", "field.sock"} <= channels.keys()
        assert set(channels.values()) == {0o600}
        assert listening(run.pid_of("observatory", "plc")) == set()


@pytest.mark.long
def test_an_emulated_field_listens_on_loopback(tmp_path: Path) -> None:
    port = free_port()
    with fieldtwin(tmp_path, "emulate", "observatory", "--control", f"{LOOPBACK}:{port}") as side:
        wait_for(lambda: port in only_loopback(side.process.pid), 20, "its control channel")
        wait_for(
            lambda: len(only_loopback(side.process.pid)) == 4, 20, "CAN bus, modem, topside modem and control channel"
        )


@pytest.mark.long
@pytest.mark.parametrize("mode", [("can-bus", "--listen"), ("bridge",)], ids=["can-bus", "bridge"])
def test_other_servers_listen_only_at_their_configured_endpoints(tmp_path: Path, mode: tuple[str, ...]) -> None:
    port = free_port()
    words = {
        "can-bus": ("can-bus", "--listen", f"{LOOPBACK}:{port}"),
        "bridge": ("bridge", f"tcp://{LOOPBACK}:{port}", f"tcp://{LOOPBACK}:{free_port()}"),
    }[mode[0]]
    with fieldtwin(tmp_path, *words) as server:
        wait_for(lambda: server.process.poll() is not None or listening(server.process.pid), 20, "it listens")
        assert alive(server.process.pid), server.err
        assert listening(server.process.pid) == {(LOOPBACK, port)}


def test_a_control_channel_off_loopback_needs_a_token(tmp_path: Path) -> None:
    refused = run_to_end(tmp_path, "emulate", "observatory", "--control", f"0.0.0.0:{free_port()}")
    assert refused.process.returncode == 2, refused.err
    assert "token" in refused.err
    port = free_port()
    (tmp_path / "token").write_text("correct horse\n")
    token = ("--token", f"@{tmp_path / 'token'}")
    with fieldtwin(tmp_path, "emulate", "observatory", "--control", f"0.0.0.0:{port}", *token, name="open") as side:
        wait_for(lambda: ("0.0.0.0", port) in listening(side.process.pid), 20, side.err)
        with pytest.raises((AssertionError, ConnectionResetError)):
            Asking((LOOPBACK, port))("ready")  # without the token


@pytest.mark.long
def test_a_digital_thread_without_certificates_is_refused_off_loopback(tmp_path: Path) -> None:
    words = ("run", "observatory", "--prototype", "--for", "1s", "--thread", f"tcp://0.0.0.0:{free_port()}")
    refused = run_to_end(tmp_path, *words)
    assert refused.process.returncode in (2, 3), refused.err
    assert "loopback" in refused.err


# -- a plant: served ports, with and without TLS ------------------------------------------------------------------------


def a_plant(folder: Path, serve: str, bridge: str = "") -> Path:
    """A system file with missing devices that serves and bridges at these URLs."""
    text = (CHECKOUT / "profiles" / "systems" / "observatory.yaml").read_text(encoding="utf-8")
    for old, new in (
        ("/dev/ttyS0", str(folder / "ttyNONE")),
        ("socketcan/can0", "socketcan/nocan0"),
        ("modem:502", f"{LOOPBACK}:{free_port()}"),
        ('"tcp://127.0.0.1:1502"', f'"{serve}"'),
    ):
        assert old in text
        text = text.replace(old, new)
    text = re.sub(r"(?m)^bridge:\n(?:[ \t].*\n|\n)*", "", text)
    if bridge:
        text += f'\nbridge:\n  door:\n    url: "{bridge}"\n    units: {{11: line1/1}}\n'
    path = folder / "site.yaml"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.long
def test_a_plant_listens_only_at_the_endpoints_of_serve_and_bridge(tmp_path: Path) -> None:
    serve, bridge = free_port(), free_port()
    site = a_plant(tmp_path, f"tcp://{LOOPBACK}:{serve}", f"tcp://{LOOPBACK}:{bridge}")
    with fieldtwin(tmp_path, "run", str(site), "--plant", "--instance", "p", "--json") as run:
        gateway = run.control("p", "gateway")
        run.control("p", "plc")
        wait_for(lambda: listening(run.pid_of("p", "gateway")), 20, "it serves")
        wait_for(lambda: len(listening(run.process.pid)) == 2, 20, str(gateway("get")["serve"]))
        assert listening(run.process.pid) == {(LOOPBACK, serve), (LOOPBACK, bridge)}
        channels = {path.name: stat.S_IMODE(path.stat().st_mode) for path in (tmp_path / "p").glob("*.sock")}
        assert channels == {"gateway.sock": 0o600, "plc.sock": 0o600}


@pytest.mark.long
def test_a_plant_listens_off_loopback_only_if_its_file_requests_it(tmp_path: Path) -> None:
    """With `serve` and with a thread, both on TLS: connections without a certificate of the authority are refused."""
    pki = make_pki(tmp_path)
    keys = f"ca={pki.ca}&cert={pki.cert('server')}&key={pki.key('server')}"
    serve, thread = free_port(), free_port()
    site = a_plant(tmp_path, f"tls://0.0.0.0:{serve}?{keys}")
    words = ("run", str(site), "--plant", "--instance", "p", "--json", "--thread", f"tls://0.0.0.0:{thread}?{keys}")
    with fieldtwin(tmp_path, *words) as run:
        run.control("p", "gateway")
        run.control("p", "thread")
        wait_for(lambda: len(listening(run.process.pid)) >= 2, 20, "serve and thread")
        assert listening(run.process.pid) == {("0.0.0.0", serve), ("0.0.0.0", thread)}
        for port in (serve, thread):
            with socket.create_connection((LOOPBACK, port), timeout=5) as stranger:
                stranger.sendall(bytes.fromhex("0001 0000 0006 01 04 0000 0002"))  # Modbus TCP without TLS
                stranger.settimeout(15)
                with_what = b""
                try:
                    while piece := stranger.recv(64):
                        with_what += piece
                except ConnectionResetError:
                    pass
                assert with_what[:1] in (b"", b"\x15"), with_what  # nothing, or a TLS alert


# -- the test host ----------------------------------------------------------------------------------------------------


@pytest.mark.long
def test_the_test_host_listens_only_for_its_devices_on_loopback(tmp_path: Path) -> None:
    environment = {**os.environ, "PYTHONPATH": str(CHECKOUT), "FIELDTWIN_RUN": str(tmp_path)}
    with subprocess.Popen(
        [sys.executable, "-m", "fieldtwin", "test-host"],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, env=environment, cwd=tmp_path,
    ) as host:  # fmt: skip
        assert host.stdin is not None
        assert host.stdout is not None
        number = 0

        def ask(command: str, **args: Any) -> Any:
            nonlocal number
            number += 1
            line = json.dumps({"v": 1, "id": number, "command": command, "args": args}).encode() + b"\n"
            host.stdin.write(line)  # type: ignore[union-attr]
            host.stdin.flush()  # type: ignore[union-attr]
            answer = json.loads(host.stdout.readline())  # type: ignore[union-attr]
            assert answer["ok"], answer
            return answer["result"]

        ask("hello")
        assert listening(host.pid) == set()
        device = ask("device", device="ctd-reference", on="tcp")
        assert len(only_loopback(host.pid)) == 1
        system = ask("system", system="observatory")
        assert len(only_loopback(host.pid)) >= 2
        for made in (device, system):
            ask("end", id=made["id"])
        assert listening(host.pid) == set()
        host.stdin.close()
        assert host.wait(15) == 0
