"""Run ``fieldtwin what-if`` from the present state of an instance as a child process, and keep its forecast."""

from __future__ import annotations

import asyncio
import json
import shlex
import tempfile
from collections.abc import Collection
from pathlib import Path
from typing import Any

import msgspec

from fieldtwin.gateway.core.errors import EndpointBusy, NotAllowed, UsageError
from fieldtwin.studio.child_run import ChildRun
from fieldtwin.studio.live.attachment import Attachment
from fieldtwin.studio.twin.followers import short_system

MOST_HORIZON_S = 24 * 3600.0
MOST_SERIES = 8
MOST_COMMANDS = 20
MOST_FAULTS = 20
MOST_EXPRESSIONS = 20
FAULT_FILE = "faults.yaml"


class PlannedPeriod(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A sampling period in seconds that the topside controller commands `at_s` seconds after now."""

    period_s: int
    at_s: float = 0.0


class AskWhatIf(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A what-if question: the horizon in seconds, and the commands and faults within it.

    `faults` are as in a fault file, and their times count from now: ``{"name": "silence", "device": "ctd", "from": "1min"}``.
    `require` are expressions that must hold all the time, `finally_` at the end. `series` are the tags whose values over time
    are wanted.
    """

    horizon_s: float
    commands: list[PlannedPeriod] = []
    faults: list[dict[str, Any]] = []
    require: list[str] = []
    finally_: list[str] = msgspec.field(default_factory=list, name="finally")
    series: list[str] = []


class Forecaster:
    """The server's forecasts, one at a time. Use it as ``async with Forecaster() as forecaster``; leaving the block stops it."""

    def __init__(self) -> None:
        self._run: ChildRun | None = None
        self._instance = ""
        self._asked: dict[str, Any] = {}
        self._began_ns = 0
        self._command = ""
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        self._starting = asyncio.Lock()

    async def __aenter__(self) -> Forecaster:
        return self

    async def __aexit__(self, *error: object) -> None:
        await self.stop()
        if self._folder is not None:
            self._folder.cleanup()

    def state(self, instance: str) -> dict[str, Any] | None:
        """Return the present or the latest run for an instance, None if there was none.

        `command` is the command line, in which ``faults.yaml`` stands for a file with the faults of `asked`.
        `began_ns`, the instant of the fork, counts on the run's monotonic clock; times of the series count from it.
        """
        run = self._run
        if run is None or self._instance != instance:
            return None
        return {
            "asked": self._asked,
            "command": self._command,
            "began_ns": self._began_ns,
            "running": run.is_running,
            "elapsed_s": run.elapsed_s,
            "trouble": run.trouble.replace(f"{self._folder.name}/", "") if self._folder is not None else run.trouble,
            "result": run.result,
        }

    async def start(self, attachment: Attachment, asked: AskWhatIf) -> None:
        """Start the forecast for a question.

        Raises `UsageError` for a question that is too large, `NotAllowed` for one about a secret tag, and `EndpointBusy` while
        another question is answered.
        """
        _check(asked, attachment.secrets)
        async with self._starting:  # of two questions at the same instant, the second finds the first running
            if self._run is not None and self._run.is_running:
                raise EndpointBusy(
                    "a forecast is running already", got=self._instance, hint="stop it, or wait for its end"
                )
            arguments = ["what-if", short_system(attachment.record), "--from", f"instance:{attachment.name}"]
            arguments += ["--horizon", f"{asked.horizon_s:g}s"]
            for command in asked.commands:
                arguments += ["--command", f"{command.period_s}@{command.at_s:g}s"]
            if asked.faults:
                arguments += ["--faults", FAULT_FILE]
            arguments += [part for text in asked.require for part in ("--require", text)]
            arguments += [part for text in asked.finally_ for part in ("--finally", text)]
            self._command = shlex.join(["fieldtwin", *arguments])
            if asked.faults:
                arguments[arguments.index(FAULT_FILE)] = str(self._fault_file(asked.faults))
            arguments += ["--json", *(part for name in asked.series for part in ("--series", name))]
            self._began_ns = attachment.now_ns()
            self._run = await ChildRun.started(arguments, _outcome)
            self._instance, self._asked = attachment.name, msgspec.to_builtins(asked)

    async def stop(self) -> None:
        """Stop the run, if one is running."""
        if self._run is not None:
            await self._run.stop()

    def _fault_file(self, faults: list[dict[str, Any]]) -> Path:
        if self._folder is None:
            self._folder = tempfile.TemporaryDirectory(prefix="fieldtwin-what-if-")
        path = Path(self._folder.name) / FAULT_FILE
        path.write_text(json.dumps({"faults": faults}), encoding="utf-8")  # JSON is YAML
        return path


def _check(asked: AskWhatIf, secrets: Collection[str]) -> None:
    if not 0 < asked.horizon_s <= MOST_HORIZON_S:
        raise UsageError(
            "the horizon", expected=f"over 0 s to {MOST_HORIZON_S / 3600:g} h", got=f"{asked.horizon_s:g} s"
        )
    for what, items, most in (
        ("commands", asked.commands, MOST_COMMANDS),
        ("faults", asked.faults, MOST_FAULTS),
        ("requirements", [*asked.require, *asked.finally_], MOST_EXPRESSIONS),
        ("series", asked.series, MOST_SERIES),
    ):
        if len(items) > most:
            raise UsageError(f"too many {what}", expected=f"at most {most}", got=str(len(items)))
    for text in (*asked.series, *asked.require, *asked.finally_):
        for name in secrets:
            if name in text:
                raise NotAllowed(
                    f"{name} is secret, so a forecast does not tell its value", hint="ask about another tag"
                )
    for command in asked.commands:
        if not 0 <= command.at_s < asked.horizon_s:
            raise UsageError("the time of a command", expected="within the horizon", got=f"{command.at_s:g} s")


def _outcome(output: bytes) -> dict[str, Any]:
    found = msgspec.json.decode(output, type=dict[str, Any])
    [outcome] = found["outcomes"]
    return dict(outcome)
