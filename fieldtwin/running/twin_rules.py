"""The rules of a digital twin's planner, from a YAML file, or a planner in Python.

```yaml
what_if: {horizon: 30min, require: ["quality(ctd.pressure) == 'good'"]}    # asked of a prototype before each command
rules:
  - {when: outside, of: ctd.pressure, period_s: 1}      # an event: sample every second
  - {when: inside, of: ctd.pressure, period_s: 60}
  - {when: stale, period_s: 0, what_if: false}          # of anything; nobody is asked
```
"""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import ConfigDict, Field

from emulators.faults.schema import seconds
from gateway.core.errors import FileInvalid, UsageError
from gateway.core.values import COMMAND, DATA
from gateway.core.yaml_file import Key, YamlFile, load, validate
from twin.mape.plan import Planner, Rule, RulePlanner
from twin.mape.what_if import Question
from twin.model import DigitalModel
from twin.system import System
from twin.system_schema import Strict

Finding = Literal["agree", "mismatch", "outside", "inside", "bad", "good", "stale", "fresh", "unreadable"]
Expression = Annotated[str, Field(min_length=1, max_length=1000)]


class QuestionForm(Strict):
    """What a prototype is asked before a command is sent. At least one expression must be required."""

    model_config = ConfigDict(validate_by_name=False)

    horizon: str = Field(description="how far ahead, such as 30min")
    settle: str = Field(default="5s", description="from when on `require` counts")
    require: list[Expression] = Field(default=[], max_length=100, description="what must hold all the time")
    finally_: list[Expression] = Field(default=[], alias="finally", max_length=100, description="and at the end")


class RuleForm(Strict):
    """What to command when something is found."""

    when: Finding
    of: str = Field(default="", description="a tag or a program; empty: whatever it is found of")
    period_s: int = Field(ge=-32768, le=32767)
    what_if: QuestionForm | Literal[False] | None = Field(
        default=None, description="a question of its own; false: nobody is asked"
    )


class RulesForm(Strict):
    """A planner as rules; the first that fits decides."""

    what_if: QuestionForm | None = Field(default=None, description="asked before each command that does not say more")
    rules: list[RuleForm] = Field(min_length=1, max_length=1000)


def load_planner(source: str, system: System) -> tuple[Planner, Question | None]:
    """``FILE.yaml``, or ``python: module:Class`` with the folder of the system file first; and what the file asks before each
    command for which no rule says more. Raises `FileInvalid`."""
    language, _, rest = source.partition(":")
    if language.strip() == "python":
        return PythonPlanner(source, rest.strip(), system), None
    file = load(Path(source))
    form = validate(file, RulesForm)
    known = {f"{d.name}.{t.name}" for d in system.devices.values() for t in d.profile.tags.values()} | set(
        system.plc.programs
    )
    rules = []
    for i, rule in enumerate(form.rules):
        if rule.of and rule.of not in known:
            raise file.error(("rules", i, "of"), f"{system.name} has no {rule.of!r}", expected="a tag or a program")
        ask: Question | bool = rule.what_if is None
        if isinstance(rule.what_if, QuestionForm):
            ask = _question(file, ("rules", i, "what_if"), rule.what_if)
        rules.append(Rule(rule.when, rule.of, rule.period_s, ask))
    return RulePlanner(rules), _question(file, ("what_if",), form.what_if) if form.what_if is not None else None


def questions_of(planner: Planner) -> list[Question]:
    """What rules ask of their own."""
    rules = planner.rules if isinstance(planner, RulePlanner) else ()
    return list(dict.fromkeys(rule.ask for rule in rules if isinstance(rule.ask, Question)))


def _question(file: YamlFile, loc: tuple[Key, ...], form: QuestionForm) -> Question:
    if not form.require and not form.finally_:
        raise file.error(loc, "nothing is required", expected="`require` or `finally`, a list of expressions")
    times = {}
    for key, text in (("horizon", form.horizon), ("settle", form.settle)):
        try:
            times[key] = seconds(text)
        except UsageError as e:
            raise file.error((*loc, key), e.message, expected=e.expected, got=e.got) from e
    return Question(times["horizon"], tuple(form.require), tuple(form.finally_), times["settle"])


class PythonPlanner:
    """A planner that somebody wrote: whatever it raises is a `FileInvalid` that names it."""

    def __init__(self, source: str, name: str, system: System) -> None:
        self._source = source
        module, _, kind = name.partition(":")
        folder = str(system.path.parent)
        if folder not in sys.path:
            sys.path.insert(0, folder)
        try:
            self._made: Any = getattr(importlib.import_module(module), kind)()
        except Exception as e:  # a user's module can raise anything; translated here, once
            raise FileInvalid(f"the planner {source!r} cannot be made: {type(e).__name__}: {e}") from e
        if not callable(getattr(self._made, "plan", None)):
            raise FileInvalid("not a planner", expected="a class with plan(data, model)", got=source)

    def plan(self, data: DATA, model: DigitalModel) -> COMMAND | None:
        try:
            found = self._made.plan(data, model)
        except Exception as e:  # as above
            raise FileInvalid(f"the planner {self._source!r} failed: {type(e).__name__}: {e}") from e
        if found is not None and not isinstance(found, COMMAND):
            got = type(found).__name__
            raise FileInvalid(f"the planner {self._source!r} gave no plan", expected="a COMMAND or None", got=got)
        return found
