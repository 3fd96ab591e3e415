"""The tags that clients of a gateway may write: on a read-only plant none, and never those that a program or a group writes."""

from __future__ import annotations

from pathlib import Path

import pytest

from fieldtwin.gateway.connections.os_connector import OsConnector
from fieldtwin.gateway.runtime.audit_log import AuditLog
from fieldtwin.gateway.store.exchange_log import ExchangeLog
from fieldtwin.gateway.wallclock import WallClock
from fieldtwin.twin.plant.physical import EmbeddedControlSystem, attached
from fieldtwin.twin.site.system import load_system

FILES = {
    "fan.yaml": """\
device: test/fan
source: "a test"
protocol: modbus
tags:
  mode:  {at: "holding:0", type: uint16, access: rw}
  limit: {at: "holding:1", type: uint16, access: rw}
  other: {at: "holding:2", type: uint16, access: rw}
""",
    "fan.st": "PROGRAM Fan\nVAR_OUTPUT mode : INT; END_VAR\n  mode := 1;\nEND_PROGRAM\n",
    "hall.yaml": """\
fieldtwin: 1
system: hall
buses: {lan: {url: "tcp://192.0.2.1:502"}, line: {url: "tcp://192.0.2.2:502"}}
devices:
  a: {profile: ./fan.yaml, bus: lan, unit: 1, writable: [mode, limit]}
  b: {profile: ./fan.yaml, bus: line, unit: 1, writable: [mode]}
plc: {programs: {control: {source: fan.st, outputs: {mode: a.mode}}}}
""",
}


@pytest.mark.parametrize(
    ("allow_writes", "read_only", "tags"),
    [(True, (), ["a.limit", "b.mode"]), (True, ("line",), ["a.limit"]), (False, (), [])],
)
def test_only_writable_tags_that_no_program_commands_may_be_written(
    tmp_path: Path, allow_writes: bool, read_only: tuple[str, ...], tags: list[str]
) -> None:
    for name, text in FILES.items():
        (tmp_path / name).write_text(text, encoding="utf-8")
    ecs, clock = EmbeddedControlSystem(load_system(str(tmp_path / "hall.yaml"))), WallClock()
    ecs.prepare(tmp_path)
    audit, log = (
        AuditLog(tmp_path / "audit.jsonl", clock),
        ExchangeLog(tmp_path / "store.sqlite", system="hall", prototype=False),
    )
    with attached(ecs.layout, tmp_path / "image") as image:
        gateway = ecs.gateway(OsConnector(), clock, image, audit, log, allow_writes=allow_writes, read_only=read_only)
        assert sorted(gateway.client_tags()) == tags
    log.close()
    audit.close()
