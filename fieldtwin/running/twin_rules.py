"""The rules of a digital twin's planner, from a YAML file, or a planner in Python.

```yaml
rules:
  - {when: outside, of: ctd.pressure, period_s: 1}      # an event: sample every second
  - {when: inside, of: ctd.pressure, period_s: 60}
  - {when: stale, period_s: 0}                          # of anything
```
"""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from typing import Literal

from pydantic import Field

from gateway.core.errors import FileInvalid
from gateway.core.yaml_file import load, validate
from twin.mape.plan import Planner, Rule, RulePlanner
from twin.system import System
from twin.system_schema import Strict

Finding = Literal["agree", "mismatch", "outside", "inside", "bad", "good", "stale", "fresh", "unreadable"]


class RuleForm(Strict):
    """What to command when something is found."""

    when: Finding
    of: str = Field(default="", description="a tag or a program; empty: whatever it is found of")
    period_s: int = Field(ge=-32768, le=32767)


class RulesForm(Strict):
    """A planner as rules; the first that fits decides."""

    rules: list[RuleForm] = Field(min_length=1, max_length=1000)


def load_planner(source: str, system: System) -> Planner:
    """``FILE.yaml``, or ``python: module:Class`` with the folder of the system file first. Raises `FileInvalid`."""
    language, _, rest = source.partition(":")
    if language.strip() == "python":
        return _python(source, rest.strip(), system)
    file = load(Path(source))
    form = validate(file, RulesForm)
    known = {f"{d.name}.{t.name}" for d in system.devices.values() for t in d.profile.tags.values()} | set(
        system.plc.programs
    )
    for i, rule in enumerate(form.rules):
        if rule.of and rule.of not in known:
            raise file.error(("rules", i, "of"), f"{system.name} has no {rule.of!r}", expected="a tag or a program")
    return RulePlanner(Rule(rule.when, rule.of, rule.period_s) for rule in form.rules)


def _python(source: str, name: str, system: System) -> Planner:
    module, _, kind = name.partition(":")
    folder = str(system.path.parent)
    if folder not in sys.path:
        sys.path.insert(0, folder)
    try:
        made: Planner = getattr(importlib.import_module(module), kind)()
    except Exception as e:  # a user's module can raise anything; translated here, once
        raise FileInvalid(f"the planner {source!r} cannot be made: {type(e).__name__}: {e}") from e
    if not callable(getattr(made, "plan", None)):
        raise FileInvalid("not a planner", expected="a class with plan(data, model)", got=source)
    return made
