"""The words of a scenario file, and what may stand behind them: strict forms, which know no system."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from fieldtwin.scenarios.probe_form import ProbeForm

Time = str | float | int
Number = float | int


class _Form(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, populate_by_name=True)


class Send(_Form):
    """The far end commands a period."""

    from_: str = Field(default="shore", alias="from")
    period_s: int


class Set(_Form):
    """A device holds a value: DEVICE.TAG; null: what it says by itself again."""

    tag: str
    value: Number | bool | str | None


class Wait(_Form):
    until: str
    within: Time = 5


class Bounds(_Form):
    min: Number | None = None
    max: Number | None = None


class WireForm(_Form):
    """What is seen on a device's wire."""

    wire: str
    access: Literal["read", "write"] | None = None
    function: int | None = None
    register_: str | None = Field(default=None, alias="register")
    value: Number | None = None
    unless: str | None = None


class Expect(_Form):
    """One thing that must be so. `tag` and its kin, or `wire` and its kin, or `that`."""

    tag: str | None = None
    value: Number | bool | str | None = None
    tolerance: Number = Field(default=0, ge=0)
    quality: str | None = None
    like: Literal["recording"] | None = None
    updates_per_s: tuple[Number, Number] | list[Number] | None = None
    wire: str | None = None
    access: Literal["read", "write"] | None = None
    function: int | None = None
    register_: str | None = Field(default=None, alias="register")
    times: int | Bounds | None = None
    requests_per_s: Bounds | None = None
    that: str | None = None
    within: Time | None = None
    during: Time | None = None


class Step(_Form):
    """One of these."""

    send: Send | None = None
    set: Set | None = None
    fault: dict[str, Any] | None = None
    clear: str | None = None
    wait: Wait | None = None
    expect: Expect | None = None
    pause: Time | None = None


class Within(_Form):
    """Each time that `after` becomes true, `then` is so `within` a time."""

    after: str
    then: str
    within: Time


class Rate(_Form):
    """How often a tag is published, or a device asked, in any stretch of `over`; `while` says when it counts."""

    tag: str | None = None
    updates_per_s: Bounds | None = None
    wire: str | None = None
    requests_per_s: Bounds | None = None
    over: Time = 10
    while_: str | None = Field(default=None, alias="while")


class Cycle(_Form):
    """How far apart the changes of a tag or variable are; or, without one, how late a scan of the PLC may begin."""

    changes_of: str | None = None
    min: Time | None = None
    max: Time | None = None
    late: Time | None = None
    while_: str | None = Field(default=None, alias="while")


class ScenarioForm(_Form):
    scenario: str = Field(min_length=1, max_length=200)
    about: str = ""
    requirements: list[str] = []
    system: str
    prototype: str | None = None
    seed: int | None = None
    start: Literal["fresh"] | None = None
    """PLC, simulations and devices begin anew first, on every target."""
    needs: list[str] = []
    stopped: list[Literal["plc"]] = []
    """Parts of the system that stop in this scenario. Without it a part that stops fails the scenario; with it, a part that does
    not stop."""
    always: list[str] = []
    never: list[str | WireForm] = []
    within: list[Within] = []
    rate: list[Rate] = []
    cycle: list[Cycle] = []
    refused: list[str] = []
    """Tags whose outputs are expected to be refused, each at least once. Any other refused output fails the scenario."""
    judge: Literal["run"] | None = None
    """Besides, by what a run in virtual time is judged by."""
    probes: dict[str, ProbeForm] = {}
    steps: list[Step] = Field(min_length=1, max_length=10_000)


WORDS = ("send", "set", "fault", "clear", "wait", "expect", "pause")


def word_of(step: Step) -> str:
    """Which of the words a step is."""
    return next(word for word in WORDS if getattr(step, word) is not None)
