"""The progress of one scenario as JSON lines, written while it runs: for displays that show a run before its result.

The writer only listens to the run's trace, so it changes no verdict. A file that can no longer be written ends the progress, not
the run. The lines are described in docs/reference/scenarios.md.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgspec

from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.results.model import ScenarioResult
from fieldtwin.results.trace import Trace, TraceEvent, TraceKind
from fieldtwin.scenarios.judging.expectation import said
from fieldtwin.scenarios.language.form import Scenario
from fieldtwin.scenarios.language.words import word_of

VALUES_EVERY_S = 0.1
"""The shortest time in seconds, on the run's clock, between two lines with values of the same name."""
MOST_VALUES = 20_000
RULES = ("always", "never", "within", "rate", "cycle")


class Progress:
    """The writer of the progress of one run to one file. Raises `FileInvalid` if the file cannot be written."""

    def __init__(self, path: Path) -> None:
        try:
            self._file = path.open("wb", buffering=0)
        except OSError as e:
            raise FileInvalid(f"cannot write the progress: {e.strerror or e}", path=str(path)) from e
        self._steps = 0
        self._names: set[str] = set()
        self._last: dict[str, tuple[int, dict[str, Any]]] = {}
        """The time and the value in the latest line of each name."""
        self._held: dict[str, TraceEvent] = {}
        """For each name, the latest change that is not written yet, because it followed the last line too soon."""
        self._values = 0

    def begin(self, scenario: Scenario, target: str, trace: Trace) -> None:
        """Write the steps and checks of the scenario, and begin to follow the trace of its run."""
        steps = [
            {"number": str(n), "text": f"{word}: {said(getattr(step, word))}"}
            for n, step in enumerate(scenario.form.steps, 1)
            for word in [word_of(step)]
        ]
        self._steps, self._names, self._values = len(steps), _names(scenario), 0
        self._last, self._held = {}, {}
        checks = [{"number": number, "text": text} for number, text in _checks(scenario)]
        line = {"scenario": scenario.form.scenario, "target": target, "steps": steps, "checks": checks}
        self._write("scenario", None, line)
        trace.listen(self._step, TraceKind.STEP)
        trace.listen(self._value, TraceKind.TAG, TraceKind.STATE, TraceKind.ALARM)

    def end(self, result: ScenarioResult) -> None:
        """Write the verdicts on the checks of the whole run, and the result."""
        for event in self._held.values():
            self._write_value(event)
        self._held = {}
        for check in result.checks:
            if not (check.number.isdigit() and int(check.number) <= self._steps):
                more = {"number": check.number, "text": check.text, "verdict": check.verdict.value}
                self._write("verdict", check.t_ns, more)
        self._write("result", None, {"verdict": result.verdict.value, "reason": result.reason})

    def close(self) -> None:
        """Close the file."""
        with suppress(OSError):
            self._file.close()

    def _step(self, event: TraceEvent) -> None:
        verdict = event.data.get("verdict")
        more = {"number": event.where} | ({} if verdict is None else {"verdict": verdict})
        self._write("step" if verdict is None else "verdict", event.t_ns, more)

    def _value(self, event: TraceEvent) -> None:
        name = event.where
        if name not in self._names:
            return
        last = self._last.get(name)
        held = self._held.pop(name, None)
        if last is not None:
            if (held.data if held is not None else last[1]) == event.data:
                if held is not None:
                    self._held[name] = held
                return
            if event.t_ns - last[0] < VALUES_EVERY_S * NS_PER_S:
                self._held[name] = event
                return
        if held is not None:
            self._write_value(held)
        self._write_value(event)

    def _write_value(self, event: TraceEvent) -> None:
        self._last[event.where] = event.t_ns, event.data
        self._values += 1
        if self._values > MOST_VALUES:
            return
        value, quality = event.data.get("value"), event.data.get("quality", "good")
        more = {"name": event.where, "value": value, "quality": quality, "reason": event.data.get("reason", "none")}
        self._write("value", event.t_ns, more)

    def _write(self, event: str, t_ns: int | None, more: dict[str, Any]) -> None:
        time = {} if t_ns is None else {"t_s": t_ns / NS_PER_S}
        with suppress(OSError, ValueError):  # a full disk, or a reader that has closed its end
            self._file.write(msgspec.json.encode({"event": event} | time | more) + b"\n")


def _names(scenario: Scenario) -> set[str]:
    """Return the names whose values a reader of the scenario wants to see: those that it checks or sets, without secrets."""
    names = set(scenario.used)
    for step in scenario.form.steps:
        names |= {name for name in (step.expect and step.expect.tag, step.set and step.set.tag) if name}
    names |= {name for rate in scenario.form.rate for name in (rate.tag,) if name}
    secret = {
        f"{device.name}.{tag.name}"
        for device in scenario.system.devices.values()
        for tag in device.profile.tags.values()
        if tag.secret
    }
    return names - secret


def _checks(scenario: Scenario) -> Iterator[tuple[str, str]]:
    """Yield (number, text) of each check of the whole run; the check's result will have the same number."""
    for word in RULES:
        for n, one in enumerate(getattr(scenario.form, word), 1):
            yield f"{word} {n}", said(one)
    for stated in scenario.invariants.stated:
        yield stated.number, stated.expression.text
    for followed in scenario.invariants.followed:
        text = f"{followed.then.text} within {followed.limit_s:g} s of {followed.after.text}"
        yield followed.number, text
