"""Collect the results of a whole test run for one HTML page (`--fieldtwin-html`), from pytest's reports, also those of
pytest-xdist.
"""

from __future__ import annotations

import platform
import re
import shlex
import sys
from pathlib import Path
from typing import Any

import pytest

from fieldtwin.testing.runner import FieldtwinRefused, FieldtwinUnavailable, WorkerProcess, command_of

_WORKER = re.compile(r"\[gw\d+\] ")
"""The prefix ``[gwN]`` that pytest-xdist puts before the text of a failure."""


class Results:
    """The pytest plugin that collects the results; registered only if the page was requested."""

    def __init__(self, config: pytest.Config) -> None:
        self._config = config
        self._tests: dict[str, dict[str, Any]] = {}
        self._problem = ""

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Record the worst result among a test's phases (setup, call, teardown)."""
        if report.when != "call" and report.passed:
            return
        properties = list(report.user_properties)
        facts = dict(properties)
        said = facts.get("fieldtwin verdict", "")
        ended = (
            "passed"
            if report.passed
            else "skipped"
            if report.skipped
            else "failed"
            if report.when == "call"
            else "error"
        )
        file, line, _ = report.location
        self._tests[report.nodeid] = {
            "name": report.nodeid,
            "verdict": said if said in ("inconclusive", "error") else ended,
            "requirements": [str(value) for name, value in properties if name == "requirement"],
            "why": "" if report.passed else _why(report),
            "text": "" if report.passed else _reason(report),
            "took_s": report.duration,
            "reproduce": shlex.join(["pytest", report.nodeid]),
            "file": file,
            "line": (line or 0) + 1,
            **{name: str(facts.get(name, "")) for name in ("case", "role", "impact")},
        }

    def pytest_sessionfinish(self) -> None:
        runner = WorkerProcess(command_of(self._config.getoption("--fieldtwin-command")))
        try:
            runner.call(
                "report",
                file=str(Path(self._config.getoption("--fieldtwin-html")).resolve()),
                title=self._config.rootpath.name,
                tests=list(self._tests.values()),
                reproduce=shlex.join(["pytest", *self._config.invocation_params.args]),
                versions={"pytest": pytest.__version__, "Python": platform.python_version(), "platform": sys.platform},
            )
        except (FieldtwinRefused, FieldtwinUnavailable) as e:
            self._problem = str(e)
        finally:
            runner.close()

    def pytest_terminal_summary(self, terminalreporter: Any) -> None:
        where = self._config.getoption("--fieldtwin-html")
        if self._problem:
            terminalreporter.write_line(f"fieldtwin: no report was written: {self._problem}", red=True)
        else:
            terminalreporter.write_sep("-", f"report: {where}")


def _why(report: pytest.TestReport) -> str:
    """Return one line: a scenario's verdict and its reason, or a test's error."""
    crash = getattr(report.longrepr, "reprcrash", None)
    said = str(crash.message) if crash is not None else _reason(report)
    lines = [line for line in said.splitlines() if line.strip()]
    errors = [line[1:].strip() for line in lines if line.startswith("E ")]
    return next(iter(errors or lines), "")[:300]


def _reason(report: pytest.TestReport) -> str:
    if report.skipped and isinstance(report.longrepr, tuple):
        return report.longrepr[2].removeprefix("Skipped: ")
    lines = report.longreprtext.splitlines()
    return "\n".join(lines[1:] if lines and _WORKER.match(lines[0]) else lines)[-4000:]
