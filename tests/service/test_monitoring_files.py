"""The files of packaging/monitoring fit the metrics: the dashboard is the generated one, and alerts name metrics that exist."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import yaml
from grafana_foundation_sdk.cog.encoder import JSONEncoder
from grafana_foundation_sdk.models.dashboard import Dashboard
from test_service_metrics import scraped, whole

from fieldtwin.service.exposition import render
from fieldtwin.service.metric_families import ALL
from fieldtwin.service.metrics import families

ROOT = Path(__file__).parents[2]
MONITORING = ROOT / "packaging" / "monitoring"
DASHBOARD: dict[str, Any] = json.loads((MONITORING / "fieldtwin.dashboard.json").read_text(encoding="utf-8"))
RULES: list[dict[str, Any]] = yaml.safe_load((MONITORING / "fieldtwin.rules.yml").read_text(encoding="utf-8"))[
    "groups"
][0]["rules"]
PAGE = (ROOT / "docs" / "reference" / "metrics.md").read_text(encoding="utf-8")
GUIDE = (ROOT / "docs" / "how-to" / "monitoring.md").read_text(encoding="utf-8")
SELECTOR = re.compile(r"(fieldtwin_[a-z_]+|^up)(?:\{([^}]*)\})?")


def selectors(expression: str) -> list[tuple[str, set[str]]]:
    """Return each metric of a PromQL expression with the labels that its selector names."""
    return [(name, set(re.findall(r'(\w+)(?:=~|!~|!=|=)"', inside))) for name, inside in SELECTOR.findall(expression)]


def test_the_dashboard_is_the_one_that_the_script_makes() -> None:
    done = subprocess.run(
        [sys.executable, ROOT / "scripts" / "grafana-dashboard"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


def test_the_dashboard_has_the_form_of_grafana_s_schema() -> None:
    """Every key is one that the models of Grafana's schema know: reading and writing the dashboard with them loses nothing."""
    again = json.loads(JSONEncoder().encode(Dashboard.from_json(DASHBOARD)))
    assert again == DASHBOARD
    assert DASHBOARD["schemaVersion"] >= 39
    ids = [panel["id"] for panel in DASHBOARD["panels"]]
    assert sorted(set(ids)) == ids
    for panel in DASHBOARD["panels"]:
        assert panel["gridPos"]["x"] + panel["gridPos"]["w"] <= 24
        assert panel["type"] == "row" or panel["datasource"] == {"type": "prometheus", "uid": "${datasource}"}


def test_alerts_name_metrics_and_labels_that_are_served() -> None:
    labels: dict[str, set[str]] = {}
    for name, of in scraped(render(families(whole()))):
        labels.setdefault(name, {"job", "instance"}).update(label for label, _ in of)
    labels["up"] = {"job", "instance"}
    for rule in RULES:
        found = selectors(rule["expr"])
        for name, named in found:
            assert named <= labels[name], rule["alert"]
        left, _ = found[0]  # an alert has the labels of the left side
        assert set(re.findall(r"\$labels\.(\w+)", str(rule["annotations"]))) <= labels[left], rule["alert"]


def test_every_alert_is_in_the_docs_and_every_alert_of_the_docs_exists() -> None:
    alerts = {rule["alert"] for rule in RULES}
    assert set(re.findall(r"^\| `(Fieldtwin\w+)`", PAGE, re.MULTILINE)) == alerts
    assert set(re.findall(r"`(Fieldtwin\w+)`", GUIDE)) <= alerts


def test_every_metric_is_in_the_docs() -> None:
    named = set(re.findall(r"`(fieldtwin_[a-z_]+)", PAGE))
    parts = tuple(re.findall(r"`(_[a-z_]+)", PAGE))
    assert [metric.name for metric in ALL if metric.name not in named and not metric.name.endswith(parts)] == []
