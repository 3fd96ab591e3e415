"""The rules of a digital twin's planner, from a YAML file, or a planner in Python.

```yaml
limits: {ctd.pressure: [0, 500]}                        # what `outside` means, where the profile has no range or another one
what_if: {horizon: 30min, require: ["quality(ctd.pressure) == 'good'"]}    # simulated before each command
rules:
  - {when: outside, of: ctd.pressure, period_s: 1}      # an event: sample every second
  - {when: inside, of: ctd.pressure, period_s: 60}
  - {when: stale, of: ctd.pressure, period_s: 60, what_if: false}      # no prototype is asked
```
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Literal, NamedTuple

from pydantic import ConfigDict, Field

from fieldtwin.emulators.faults.schema import seconds
from fieldtwin.gateway.core.errors import FileInvalid, UsageError
from fieldtwin.gateway.core.files.yaml_file import Key, YamlFile, load, validate
from fieldtwin.gateway.core.values import COMMAND, DATA
from fieldtwin.run.shadow.shadow import limits_of
from fieldtwin.twin.model.mape.plan import Planner, PlanRule, RulePlanner
from fieldtwin.twin.model.mape.what_if import Question
from fieldtwin.twin.model.model import DigitalModel
from fieldtwin.twin.model.variables import Limits
from fieldtwin.twin.site.base_forms import SiteModel, TagName
from fieldtwin.twin.site.system import System

Finding = Literal["agree", "mismatch", "outside", "inside", "bad", "good", "stale", "fresh", "unreadable"]
Range = Annotated[list[float], Field(min_length=2, max_length=2)]
Expression = Annotated[str, Field(min_length=1, max_length=1000)]


class QuestionForm(SiteModel):
    """The query to a prototype before a command is sent. At least one expression must be required."""

    model_config = ConfigDict(validate_by_name=False)

    horizon: str = Field(description="simulated time, such as 30min")
    settle: str = Field(default="5s", description="time from which on `require` is checked")
    require: list[Expression] = Field(default=[], max_length=100, description="expressions that must always hold")
    finally_: list[Expression] = Field(
        default=[], alias="finally", max_length=100, description="expressions that must hold at the end"
    )


class RuleForm(SiteModel):
    """A rule: the command that follows from a finding."""

    when: Finding
    of: str = Field(default="", description="a tag or a program; empty: every tag and program")
    period_s: int = Field(ge=-32768, le=32767)
    what_if: QuestionForm | Literal[False] | None = Field(
        default=None, description="the simulation for this rule; false: none"
    )


class RulesForm(SiteModel):
    """A planner that consists of rules; the first rule that fits decides."""

    limits: dict[TagName, Range] = Field(
        default={}, description="tag -> [lowest, highest], instead of the range in its profile"
    )
    what_if: QuestionForm | None = Field(
        default=None, description="the simulation before each command without a separate `what_if`"
    )
    rules: list[RuleForm] = Field(min_length=1, max_length=1000)


class Plans(NamedTuple):
    """A planner, the default query to a prototype before each command, and the limits that the planner receives."""

    planner: Planner
    question: Question | None = None
    limits: Mapping[str, Limits] = MappingProxyType({})


def load_planner(source: str, system: System) -> Plans:
    """Load ``FILE.yaml``, or ``python: module:Class`` from the system file's folder or the current one.

    Raises `FileInvalid`.
    """
    language, _, rest = source.partition(":")
    if language.strip() == "python":
        made = PythonPlanner(source, rest.strip(), system)
        return Plans(made, limits=limits_of(system) | made.limits)
    file = load(Path(source))
    form = validate(file, RulesForm)
    tags = {f"{d.name}.{t.name}" for d in system.devices.values() for t in d.profile.tags.values()}
    for name, (low, high) in form.limits.items():
        if name not in tags:
            raise file.error(("limits", name), f"{system.name} has no {name!r}", expected="a tag")
        if not low <= high:
            raise file.error(("limits", name), "limits", expected="the smallest, then the largest")
    limits = limits_of(system) | {name: (low, high) for name, (low, high) in form.limits.items()}
    rules = []
    for i, rule in enumerate(form.rules):
        if rule.of and rule.of not in tags | set(system.plc.programs):
            raise file.error(("rules", i, "of"), f"{system.name} has no {rule.of!r}", expected="a tag or a program")
        if rule.when in ("outside", "inside") and rule.of and rule.of not in limits:
            raise file.error(
                ("rules", i, "of"), f"{rule.of} has no limits for the condition {rule.when}",
                expected=f"`limits: {{{rule.of}: [LEAST, MOST]}}` in this file, or `range` in its profile",
            )  # fmt: skip
        ask: Question | bool = rule.what_if is None
        if isinstance(rule.what_if, QuestionForm):
            ask = _question(file, ("rules", i, "what_if"), rule.what_if)
        rules.append(PlanRule(rule.when, rule.of, rule.period_s, ask))
    question = _question(file, ("what_if",), form.what_if) if form.what_if is not None else None
    return Plans(RulePlanner(rules), question, limits)


def questions_of(planner: Planner) -> list[Question]:
    """Return the rules' own queries to a prototype."""
    rules = planner.rules if isinstance(planner, RulePlanner) else ()
    return list(dict.fromkeys(rule.ask for rule in rules if isinstance(rule.ask, Question)))


def _question(file: YamlFile, loc: tuple[Key, ...], form: QuestionForm) -> Question:
    if not form.require and not form.finally_:
        raise file.error(loc, "no requirement is given", expected="`require` or `finally`, a list of expressions")
    times = {}
    for key, text in (("horizon", form.horizon), ("settle", form.settle)):
        try:
            times[key] = seconds(text)
        except UsageError as e:
            raise file.error((*loc, key), e.message, expected=e.expected, got=e.got) from e
    return Question(times["horizon"], tuple(form.require), tuple(form.finally_), times["settle"])


class PythonPlanner:
    """A planner in user code. Any exception in it becomes a `FileInvalid` that names it.

    `limits` is the planner's attribute of that name, None if it has none.
    """

    def __init__(self, source: str, name: str, system: System) -> None:
        self._source = source
        module, _, kind = name.partition(":")
        for folder in (str(Path.cwd()), str(system.path.parent)):
            if folder not in sys.path:
                sys.path.insert(0, folder)
        try:
            self._made: Any = getattr(importlib.import_module(module), kind)()
        except Exception as e:  # a user's module can raise any exception, which is translated here
            raise FileInvalid(f"the planner {source!r} cannot be created: {type(e).__name__}: {e}") from e
        if not callable(getattr(self._made, "plan", None)):
            raise FileInvalid("not a planner", expected="a class with plan(data, model)", got=source)
        try:
            said = getattr(self._made, "limits", {})
            self.limits = {str(name): (float(low), float(high)) for name, (low, high) in said.items()}
        except (AttributeError, TypeError, ValueError) as e:
            expected = "{'ctd.pressure': (0, 500)}"
            raise FileInvalid(f"the limits of {source!r}", expected=expected, got=repr(said)[:80]) from e

    def plan(self, data: DATA, model: DigitalModel) -> COMMAND | None:
        try:
            found = self._made.plan(data, model)
        except Exception as e:  # as above
            raise FileInvalid(f"the planner {self._source!r} failed: {type(e).__name__}: {e}") from e
        if found is not None and not isinstance(found, COMMAND):
            got = type(found).__name__
            raise FileInvalid(f"the planner {self._source!r} gave no plan", expected="a COMMAND or None", got=got)
        return found
