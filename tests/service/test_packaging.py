"""Statements about packages and services are true: extras, the systemd unit, the metrics that docs name."""

from __future__ import annotations

import configparser
import re
import tomllib
from pathlib import Path

from click.testing import CliRunner
from test_service_metrics import whole

from fieldtwin.cli.main import COMMANDS
from fieldtwin.cli.run.run_command import command
from fieldtwin.service.metrics import families

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
METRICS = (ROOT / "docs" / "reference" / "metrics.md").read_text()
PACKAGES = (ROOT / "docs" / "reference" / "packages.md").read_text()


def unit() -> configparser.ConfigParser:
    parser = configparser.ConfigParser(strict=False, interpolation=None)
    parser.optionxform = str  # type: ignore[assignment,method-assign]
    parser.read(ROOT / "packaging" / "systemd" / "fieldtwin@.service")
    return parser


def test_every_extra_is_in_the_docs_and_the_other_way_round() -> None:
    table = PACKAGES.split("| extra |")[1].split("\n\n")[0]
    said = dict(re.findall(r"^\| `([a-z]+)` \| ([^|]+?) \|", table, re.MULTILINE))
    assert said.keys() == PROJECT["optional-dependencies"].keys()
    for extra, brings in said.items():
        if extra not in ("dev", "docs"):
            wanted = [re.split(r"[><=;\[ ]", r)[0] for r in PROJECT["optional-dependencies"][extra]]
            assert ", ".join(wanted).lower() == brings.lower()


def test_no_page_names_an_extra_that_there_is_not() -> None:
    pages = [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]
    named = {
        extra
        for page in pages
        for group in re.findall(r"fieldtwin\[([a-z,]+)\]", page.read_text())
        for extra in group.split(",")
    }
    assert {"test", "mqtt", "postgres"} <= named
    assert named <= PROJECT["optional-dependencies"].keys()


def test_the_metrics_in_the_docs_are_served() -> None:
    table = METRICS.split("| metric |")[1].split("\n\n")[0]
    served = {family.name for family in families(whole())}
    assert set(re.findall(r"`(fieldtwin_[a-z_]+)", METRICS)) <= served
    parts = re.findall(r"`(_[a-z_]+)", table)
    assert parts
    assert [p for p in parts if not any(name.endswith(p) for name in served)] == []


def test_the_unit_begins_read_only_and_names_options_that_there_are() -> None:
    service = unit()["Service"]
    assert service["Type"] == "notify"
    words = service["ExecStart"].split()
    assert "--plant" in words
    assert "--allow-writes" not in words
    shown = CliRunner().invoke(command, ["--help"]).output
    assert [w for w in words if w.startswith("--") and w not in shown] == []
    reload = service["ExecReload"].split()
    assert reload[0] == words[0]
    assert reload[1] in COMMANDS
    assert reload[-1] == words[words.index("--instance") + 1]
    assert service["WatchdogSignal"] == "SIGTERM"  # outputs are made safe before the end
    assert service["KillMode"] == "mixed"
    assert int(service["TimeoutStopSec"]) >= 10
