"""Plans: the commands and faults in a fork, and the requirements on it. The command line gives one plan, a file gives several."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field

from fieldtwin.emulators.faults.schema import seconds
from fieldtwin.gateway.core.errors import FieldtwinError, UsageError
from fieldtwin.gateway.core.files.yaml_file import YamlFile, load, validate
from fieldtwin.gateway.core.statemachine import encode_period
from fieldtwin.run.processes.topside import Scripted

MAX_PLANS = 1000
MOST_NAMED = 6
"""Number of commands and faults named in the name of a plan that is made from them; the others are counted."""
Text = Annotated[str, Field(min_length=1, max_length=1000)]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class CommandForm(_Strict):
    """A period that the topside controller commands, and the time: ``{at: 10s, period_s: 60}``."""

    at: str = "0s"
    period_s: int


class PlanForm(_Strict):
    name: Text
    commands: list[CommandForm] = []
    faults: list[dict[str, Any]] = []
    require: list[Text] = []
    finally_: list[Text] = Field(default=[], alias="finally")


class PlansForm(_Strict):
    """Several plans for one system. `require` and `finally` at the top apply to every plan."""

    what_if: Text
    require: list[Text] = []
    finally_: list[Text] = Field(default=[], alias="finally")
    plans: Annotated[list[PlanForm], Field(min_length=1, max_length=MAX_PLANS)]


@dataclass(frozen=True)
class WhatIfPlan:
    """A plan. `require` are expressions that must hold all the time, `finally_` those that must hold at the end.

    `faults` are as in a fault file.
    """

    name: str
    commands: tuple[Scripted, ...] = ()
    faults: tuple[dict[str, Any], ...] = ()
    require: tuple[str, ...] = ()
    finally_: tuple[str, ...] = ()


def command(text: str) -> Scripted:
    """Parse ``60`` or ``60@10min``: the period, and the time at which it is sent. Raises `UsageError`."""
    period, _, at = text.partition("@")
    try:
        encode_period(int(period))
        return Scripted(seconds(at) if at else 0.0, int(period))
    except (ValueError, FieldtwinError) as e:
        raise UsageError("a command", expected="PERIOD_S or PERIOD_S@TIME, such as 60@10min", got=repr(text)) from e


def in_words(commands: Sequence[Scripted], faults: Sequence[Mapping[str, Any]]) -> str:
    """Return a name for a plan that has none: ``command 2 s at 5 s, command 60 s at 10 min, fault silence on ctd``."""
    said = [f"command {one.period_s} s at {_time(one.at_s)}" for one in sorted(commands, key=lambda one: one.at_s)]
    for fault in faults:
        on = fault.get("device") or fault.get("bus")
        said.append(f"fault {fault['name']}" + (f" on {on}" if on else ""))
    more = len(said) - MOST_NAMED
    return ", ".join(said[:MOST_NAMED] or ["no commands"]) + (f" and {more} more" if more > 0 else "")


def _time(time_s: float) -> str:
    """Return a time in the largest unit in which it is a whole number, such as ``10 min``."""
    for unit_s, unit in ((3600, "h"), (60, "min")):
        if time_s and time_s % unit_s == 0:
            return f"{time_s / unit_s:g} {unit}"
    return f"{time_s:g} s"


def load_plans(path: Path) -> tuple[str, list[WhatIfPlan]]:
    """Return the system that a file of plans is for, and the plans. Raises `FileInvalid`."""
    file = load(path)
    form = validate(file, PlansForm)
    names = [plan.name for plan in form.plans]
    for n, plan in enumerate(form.plans):
        if plan.name in names[:n]:
            raise file.error(("plans", n, "name"), "two plans with the same name", expected="another", got=plan.name)
    return form.what_if, [_plan(file, form, n, plan) for n, plan in enumerate(form.plans)]


def _plan(file: YamlFile, form: PlansForm, number: int, plan: PlanForm) -> WhatIfPlan:
    commands = []
    for n, each in enumerate(plan.commands):
        try:
            commands.append(command(f"{each.period_s}@{each.at}"))
        except UsageError as e:
            raise file.error(("plans", number, "commands", n), e.message, expected=e.expected, got=e.got) from e
    return WhatIfPlan(
        plan.name,
        tuple(commands),
        tuple(plan.faults),
        (*form.require, *plan.require),
        (*form.finally_, *plan.finally_),
    )
