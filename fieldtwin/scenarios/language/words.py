"""The keywords of a scenario file, and pydantic models of their contents, which do not depend on a system."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from fieldtwin.scenarios.language.probe_form import ProbeForm

Time = str | float | int
Number = float | int


class _Form(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, populate_by_name=True)


class SendStep(_Form):
    """The step `send`: the remote client sends a command with a sample period."""

    from_: str = Field(default="topside", alias="from")
    period_s: int


class Set(_Form):
    """The step `set`: a device holds a value for DEVICE.TAG; null restores the device's own value."""

    tag: str
    value: Number | bool | str | None


class WaitStep(_Form):
    until: str
    within: Time = 5


class BoundsForm(_Form):
    min: Number | None = None
    max: Number | None = None


class WireForm(_Form):
    """A pattern of exchanges on a device's bus."""

    wire: str
    access: Literal["read", "write"] | None = None
    function: int | None = None
    register_: str | None = Field(default=None, alias="register")
    value: Number | None = None
    unless: str | None = None


class Expect(_Form):
    """One expectation: of a tag (`tag` and its keys), of exchanges on a bus (`wire` and its keys), or an expression (`that`)."""

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
    times: int | BoundsForm | None = None
    requests_per_s: BoundsForm | None = None
    that: str | None = None
    within: Time | None = None
    during: Time | None = None


class Step(_Form):
    """A step: exactly one of these keys."""

    send: SendStep | None = None
    set: Set | None = None
    fault: dict[str, Any] | None = None
    clear: str | None = None
    wait: WaitStep | None = None
    expect: Expect | None = None
    pause: Time | None = None
    acknowledge: str | None = None


class Within(_Form):
    """The rule that each time `after` becomes true, `then` must become true `within` a time."""

    after: str
    then: str
    within: Time


class Rate(_Form):
    """The rule on how often a tag must be published, or a device must be polled, in any period of `over`. It applies while
    `while` is true.
    """

    tag: str | None = None
    updates_per_s: BoundsForm | None = None
    wire: str | None = None
    requests_per_s: BoundsForm | None = None
    over: Time = 10
    while_: str | None = Field(default=None, alias="while")


class Cycle(_Form):
    """The rule on the time between changes of a tag or variable; without `changes_of`, on how late a PLC scan may begin."""

    changes_of: str | None = None
    min: Time | None = None
    max: Time | None = None
    late: Time | None = None
    while_: str | None = Field(default=None, alias="while")


class ScenarioForm(_Form):
    scenario: str = Field(min_length=1, max_length=200, examples=["The tank overflows"])
    about: str = ""
    requirements: list[str] = []
    system: str = Field(examples=["mysite.yaml"])
    prototype: str | None = None
    seed: int | None = None
    start: Literal["fresh"] | None = None
    """`fresh`: PLC, simulations and devices are restarted before the scenario, on every target."""
    needs: list[str] = []
    stopped: list[Literal["plc"]] = []
    """Parts of the system that must stop in this scenario. A part that stops without being named here fails the scenario, and
    so does a named part that does not stop.
    """
    always: list[str] = []
    never: list[str | WireForm] = []
    within: list[Within] = []
    rate: list[Rate] = []
    cycle: list[Cycle] = []
    refused: list[str] = []
    """Tags whose outputs are expected to be refused, each at least once. Any other refused output fails the scenario."""
    judge: Literal["run"] | None = None
    """`run`: the checks of `fieldtwin run` in virtual time are also applied."""
    probes: dict[str, ProbeForm] = {}
    steps: list[Step] = Field(min_length=1, max_length=10_000)


WORDS = ("send", "set", "fault", "clear", "wait", "expect", "pause", "acknowledge")


def word_of(step: Step) -> str:
    """Return the keyword of a step: one of `WORDS`."""
    return next(word for word in WORDS if getattr(step, word) is not None)
