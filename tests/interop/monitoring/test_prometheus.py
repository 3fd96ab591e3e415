"""A real Prometheus scrapes a running prototype: each query of the dashboard has data, and a lost device leaves a gap.

The alerts are checked with `promtool`: syntax, and in alerts.test.yml when each of them fires.
"""

from __future__ import annotations

import json
import math
import re
import shutil
import subprocess
import urllib.parse
import urllib.request
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
import yaml
from procs import CHECKOUT, Asking, Fieldtwin, fieldtwin, free_port, wait_for

MONITORING = CHECKOUT / "packaging" / "monitoring"
DASHBOARD: dict[str, Any] = json.loads((MONITORING / "fieldtwin.dashboard.json").read_text(encoding="utf-8"))
QUERIES = [(p["title"], t["expr"]) for p in DASHBOARD["panels"] for t in p.get("targets", [])]

pytestmark = [
    pytest.mark.interop,
    pytest.mark.long,
    pytest.mark.timeout(180),
    pytest.mark.skipif(
        shutil.which("prometheus") is None, reason="prometheus is not installed (apt install prometheus)"
    ),
]


class Prometheus:
    """A Prometheus that scrapes `target` once a second. Call it with the path and the parameters of its HTTP interface."""

    def __init__(self, folder: Path, target: str) -> None:
        self.target = target
        self.url = f"http://127.0.0.1:{free_port()}"
        config = yaml.safe_load((MONITORING / "prometheus.yml").read_text(encoding="utf-8"))
        config["global"] = {"scrape_interval": "1s", "evaluation_interval": "1s"}
        config["rule_files"] = [str(MONITORING / "fieldtwin.rules.yml")]
        config["scrape_configs"][0]["static_configs"] = [{"targets": [target]}]
        (folder / "prometheus.yml").write_text(yaml.safe_dump(config), encoding="utf-8")
        with (folder / "prometheus.err").open("wb") as err:
            self.process = subprocess.Popen(
                [
                    "prometheus", f"--config.file={folder / 'prometheus.yml'}",
                    f"--storage.tsdb.path={folder / 'data'}", f"--web.listen-address={self.url[7:]}",
                ],
                stdout=err, stderr=err,
            )  # fmt: skip

    def __call__(self, path: str, **parameters: str) -> Any:
        with urllib.request.urlopen(
            f"{self.url}/api/v1/{path}?{urllib.parse.urlencode(parameters)}", timeout=5
        ) as reply:
            answer = json.load(reply)
        assert answer["status"] == "success"
        return answer["data"]

    def ready(self) -> bool:
        assert self.process.poll() is None
        with suppress(OSError):
            return bool(self("query", query="fieldtwin_up")["result"])
        return False

    def numbers(self, query: str) -> list[float]:
        """Return the present numbers of a dashboard's query, without NaN."""
        found = [float(sample["value"][1]) for sample in self("query", query=self.filled(query))["result"]]
        return [number for number in found if not math.isnan(number)]

    def filled(self, query: str) -> str:
        """Return the query with the variables that Grafana replaces: everything is chosen."""
        for name, value in {
            "$__rate_interval": "5s", "$__range": "30s", "$system": "observatory", "$instance": self.target,
            "$device": ".*", "$tag": ".*",
        }.items():  # fmt: skip
            query = query.replace(name, value)
        return query


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Fieldtwin]:
    with fieldtwin(tmp_path_factory.mktemp("r"), "run", "observatory", "--prototype", "--metrics", "0") as started:
        yield started


@pytest.fixture(scope="module")
def prometheus(run: Fieldtwin, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Prometheus]:
    found = wait_for(lambda: re.search(r"http://(127\.0\.0\.1:\d+)/metrics", run.err), 90, "the address of the metrics")
    started = Prometheus(tmp_path_factory.mktemp("p"), found[1])
    try:
        wait_for(started.ready, 30, "the first scrape")
        yield started
    finally:
        started.process.terminate()
        started.process.wait(20)


@pytest.mark.parametrize(("title", "query"), QUERIES, ids=[f"{title}: {query[:40]}" for title, query in QUERIES])
def test_a_query_of_the_dashboard_has_data(prometheus: Prometheus, title: str, query: str) -> None:
    wait_for(lambda: prometheus.numbers(query), 30, f"data for the panel {title}: {prometheus.filled(query)}")


def test_the_choices_of_the_dashboard_are_those_of_the_run(prometheus: Prometheus) -> None:
    choices = {}
    for variable in DASHBOARD["templating"]["list"][1:]:
        found = re.fullmatch(r"label_values\((.+), (\w+)\)", variable["query"])
        assert found is not None
        matching = {"match[]": prometheus.filled(found[1])}
        choices[variable["name"]] = prometheus(f"label/{found[2]}/values", **matching)
    assert choices["system"] == ["observatory"]
    assert choices["instance"] == [prometheus.target]
    assert choices["device"] == ["ctd", "inclinometer", "modem"]
    assert {"pressure", "slope_long"} <= set(choices["tag"])


def test_the_rules_are_evaluated_without_an_error(prometheus: Prometheus) -> None:
    def evaluated() -> list[dict[str, Any]]:
        rules = [rule for group in prometheus("rules")["groups"] for rule in group["rules"]]
        return rules if all(rule["health"] != "unknown" for rule in rules) else []

    rules = wait_for(evaluated, 30, "all rules evaluated")
    assert {rule["health"] for rule in rules} == {"ok"}
    assert len(rules) == len(yaml.safe_load((MONITORING / "fieldtwin.rules.yml").read_text())["groups"][0]["rules"])


def test_a_lost_device_leaves_a_gap_and_recovers(run: Fieldtwin, prometheus: Prometheus) -> None:
    value, good = 'fieldtwin_tag_value{device="ctd",tag="status"}', 'fieldtwin_tag_good{device="ctd",tag="status"}'
    wait_for(lambda: prometheus.numbers(good) == [1.0] and prometheus.numbers(value), 30, "a good value")
    field: Asking = run.control("observatory", "field")
    field("fault", fault={"id": "cut", "name": "silence", "device": "ctd"})
    wait_for(lambda: prometheus.numbers(good) == [0.0], 30, "the value is not good")
    assert prometheus.numbers(value) == []
    wait_for(lambda: prometheus.numbers('fieldtwin_device_online{device="ctd"}') == [0.0], 30, "the device is offline")
    field("clear", id="cut")
    wait_for(lambda: prometheus.numbers(good) == [1.0] and prometheus.numbers(value), 30, "a good value again")


@pytest.mark.parametrize(
    "arguments",
    [
        ("check", "config", "packaging/monitoring/prometheus.yml"),
        ("check", "rules", "packaging/monitoring/fieldtwin.rules.yml"),
        ("test", "rules", "tests/interop/monitoring/alerts.test.yml"),
    ],
    ids=" ".join,
)
def test_promtool_accepts_the_files(arguments: tuple[str, ...]) -> None:
    done = subprocess.run(["promtool", *arguments], cwd=CHECKOUT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
