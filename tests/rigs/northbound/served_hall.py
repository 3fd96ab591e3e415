"""A small site whose tags an OPC UA server serves: a sensor with values of all kinds, and a fan that a program commands."""

from __future__ import annotations

import shutil
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager
from pathlib import Path

from asyncua import Client
from procs import Fieldtwin, fieldtwin, wait_for
from secured_server import make_certificate, write_users

from fieldtwin.northbound.opcua.access.files import create_certificate
from fieldtwin.twin.site.servers.serving_opcua import application_uri
from fieldtwin.twin.site.system import load_system

FILES = {
    "sensor.yaml": """\
device: acme/t-1000
source: "a test"
protocol: modbus
identification: {0: "Acme Works", 1: "T-1000", 2: "3.1"}
tags:
  temperature: {at: "holding:0", type: float32, poll: values, unit: degC, range: [-20, 60]}
  flow:        {at: "holding:2", type: int16, scale: 0.1, poll: values, unit: l/min}
  ticks:       {at: "holding:3", type: uint32, poll: values}
  state:       {at: "holding:5", type: uint16, poll: values, values: {0: "OFF", 1: "RUNNING", 7: "FAULT"}}
  serial:      {at: "holding:10", type: string, registers: 4, poll: identity}
  code:        {at: "holding:20", type: uint16, poll: values, secret: true}
""",
    "fan.yaml": """\
device: test/fan
source: "a test"
protocol: modbus
tags:
  mode: {at: "holding:0", type: uint16, poll: status, access: rw}
  lamp: {at: "coil:0", type: bool, poll: status, access: rw}
  limit: {at: "holding:1", type: int16, scale: 0.1, poll: status, access: rw, range: [0, 100]}
""",
    "fan.st": """\
PROGRAM Fan
VAR_INPUT temperature : REAL; END_VAR
VAR_OUTPUT mode : INT; END_VAR
VAR runs : BOOL; END_VAR
  runs := temperature > 10.0;
  IF runs THEN mode := 2; ELSE mode := 1; END_IF
END_PROGRAM
""",
    "hall.yaml": """\
fieldtwin: 1
system: hall
buses:
  lan: {url: "tcp://192.0.2.1:502", timeout_ms: 200, retries: 0}
devices:
  sensor:
    profile: ./sensor.yaml
    bus: lan
    unit: 1
    poll: {values: {every_ms: 200}, identity: {every_ms: 1000}}
    backoff_first_ms: 100
    backoff_limit_ms: 200
  fan: {profile: ./fan.yaml, bus: lan, unit: 2, poll: {status: {every_ms: 200}}, writable: [mode, lamp, limit]}
plc:
  cycle_ms: 20
  programs:
    control:
      source: "fan.st"
      inputs: {temperature: {tag: sensor.temperature}}
      outputs: {mode: fan.mode}
serve:
  scada: {kind: opcua, url: "opc.tcp://127.0.0.1:4840", every_ms: 50}
""",
    "hall.prototype.yaml": """\
prototype_of: hall.yaml
buses: {lan: {listen: "tcp://127.0.0.1:0"}}
simulations:
  room: {formulas: {temperature: "20 + 5 * sin(t)", ticks: "floor(10 * t)"}}
devices:
  sensor:
    simulation: room
    values: {flow: 12.5, state: 7, serial: "SN-0042", code: 1234}
  fan: {model: profile}
""",
}
START_WITHIN_S = 60.0


SECURITY = "security: {certificate: pki/own.der, key: pki/own.key, trusted: pki/trusted, users: pki/users.yaml}"


def write_site(folder: Path, *, secured: bool = False, more: str = "") -> Path:
    """Write the files, and return the system file. With `secured` its OPC UA server has certificates and users.

    `more` are further sections of the system file.
    """
    for name, text in FILES.items():
        (folder / name).write_text(text, encoding="utf-8")
    path = folder / "hall.yaml"
    path.write_text(FILES["hall.yaml"] + more, encoding="utf-8")
    if secured:
        text = path.read_text(encoding="utf-8").replace("every_ms: 50}", f"every_ms: 50, {SECURITY}}}")
        path.write_text(text, encoding="utf-8")
        make_pki(path)
    return path


def make_pki(system_file: Path) -> None:
    """Make the server's certificate, its users, and the certificate of a trusted client: ``hmi.der``."""
    system = load_system(str(system_file))
    [server] = system.serving.opcua
    assert server.security is not None
    create_certificate(server.security, application_uri(system.name, server.name), ["127.0.0.1"], 30)
    write_users(server.security.users)
    certificate = make_certificate(system_file.parent, "hmi")
    shutil.copy(certificate, server.security.trusted)


@contextmanager
def running(folder: Path, *options: str, secured: bool = False, more: str = "") -> Iterator[tuple[Fieldtwin, str]]:
    """A run of the site's prototype, with the URL of its OPC UA server."""
    with fieldtwin(folder, "run", str(write_site(folder, secured=secured, more=more)), "--prototype", *options) as run:
        wait_for((folder / "hall" / "gateway.sock").is_socket, START_WITHIN_S, "the gateway")
        gateway = run.control("hall", "gateway")
        url = wait_for(lambda: gateway("get", brief=True)["serve"]["scada"]["listening"], START_WITHIN_S, "the server")
        yield run, url


@asynccontextmanager
async def client(url: str) -> AsyncIterator[Client]:
    """A connected client that names the NodeIds of the system as ``ns=2``."""
    async with Client(url, timeout=20) as connected:
        yield connected
