"""The result of a scenario that `fieldtwin test` ran in a separate process: its verdict, and the reason.

This module imports only the standard library, see `fieldtwin.testing.runner`.
"""

from __future__ import annotations

import json
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fieldtwin.testing.runner import FieldtwinRefused, FieldtwinUnavailable

VERDICTS = ("passed", "failed", "error", "inconclusive", "skipped")


@dataclass(frozen=True)
class ScenarioOutcome:
    """The result of a scenario.

    `verdict` is one of `VERDICTS`; only the first is a pass. `case` is its ID, `role` the tested part, `impact` its
    impact level (observe, read, write, disrupt). `checks` are its steps and checks, in the form of `fieldtwin test
    --json`. `on_the_wire` are the exchanges before the failed check, as lines with a heading.
    """

    name: str
    verdict: str
    reason: str = ""
    seed: int | None = None
    target: str = ""
    requirements: tuple[str, ...] = ()
    checks: tuple[dict[str, Any], ...] = ()
    reproduce: str = ""
    simulated_s: float = 0.0
    trace: str = ""
    case: str = ""
    role: str = ""
    impact: str = ""
    on_the_wire: tuple[str, ...] = ()

    @property
    def passed(self) -> bool:
        return self.verdict == "passed"

    def __bool__(self) -> bool:
        """Return whether the scenario passed, for ``assert scenario("file.scenario.yaml")``."""
        return self.passed

    def __str__(self) -> str:
        return "\n".join(self.lines())

    def __repr__(self) -> str:
        """Return one line, which pytest shows in a failed assertion; the details are in the report's section ``scenario``."""
        reason = " ".join(self.reason.split())
        return f"<{self.verdict} scenario {self.name!r}" + (f": {reason}>" if reason else ">")

    def lines(self) -> list[str]:
        """Return the verdict, the expected and observed values, and the command line that repeats the run."""
        said = [f"{self.verdict.upper()}: {self.name}" + (f": {self.reason}" if self.reason else "")]
        for check in self.checks:
            if check["verdict"] != "passed":
                said += [f"  {check['number']}: {check['text']}", f"    expected {check['expected']}"]
                said += [f"    got      {check['got']}"] if check["got"] else []
        said += [f"  {'  ' if n else ''}{line}" for n, line in enumerate(self.on_the_wire)]
        return [*said, f"  again: {self.reproduce}"]


def run_scenario(
    command: Sequence[str],
    path: Path,
    *,
    seed: int | None = None,
    target: str = "",
    profiles: Sequence[str] = (),
    trust: bool = False,
) -> ScenarioOutcome:
    """Run one scenario. Raises `FieldtwinRefused` for an invalid file, `FieldtwinUnavailable` if fieldtwin cannot be run."""
    argv = [*command, "test", str(path), "--json"]
    argv += ["--seed", str(seed)] if seed is not None else []
    argv += ["--target", target] if target else []
    argv += ["--trust"] if trust else []
    for folder in profiles:
        argv += ["--profiles", folder]
    try:
        done = subprocess.run(
            argv, capture_output=True, text=True, encoding="utf-8", stdin=subprocess.DEVNULL, check=False
        )
    except OSError as e:
        raise FieldtwinUnavailable(f"cannot start {command[0]!r}: {e.strerror or e}") from e
    said = done.stderr.strip()
    if done.returncode not in (0, 1) or not done.stdout.strip():
        kind = FieldtwinRefused if done.returncode in (2, 3) else FieldtwinUnavailable
        raise kind(said.removeprefix("fieldtwin: ") or f"{argv[0]} ended with status {done.returncode}")
    try:
        plain = json.loads(done.stdout)[0]
    except (ValueError, LookupError, TypeError):
        raise FieldtwinUnavailable(f"no results: {done.stdout[:200]!r} {said}") from None
    known = {key: plain[key] for key in ScenarioOutcome.__dataclass_fields__ if key in plain}
    known |= {key: tuple(plain.get(key, ())) for key in ("requirements", "checks", "on_the_wire")}
    return ScenarioOutcome(**known)
