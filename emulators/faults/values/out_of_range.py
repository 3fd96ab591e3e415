"""A sensor outside of its range."""

from __future__ import annotations

from collections.abc import Iterable
from random import Random

from pydantic import Field

from fieldtwin.emulators.faults.fault import Parameters, ValueFault
from fieldtwin.emulators.faults.values.value_ranges import beyond, numbers
from fieldtwin.emulators.faults.wrong_aim import WrongAim
from fieldtwin.gateway.core.errors import Bug
from fieldtwin.gateway.core.files.profile import Tag


class Form(Parameters):
    value: float | None = Field(
        default=None,
        description="default: the largest value that the tag's type can carry outside its declared range",
    )


class OutOfRange(ValueFault):
    name = "out-of-range"
    summary = "the value is `value`, by default a value outside the tag's range"
    form = Form

    def __init__(self, parameters: Parameters) -> None:
        super().__init__(parameters)
        self._of_tag: dict[str, OutOfRange] = {}

    def learn(self, tags: Iterable[Tag]) -> None:
        if self.parameters.value is not None:
            return
        for tag in numbers(tags):
            try:
                self._of_tag[tag.name] = OutOfRange(Form(value=beyond(tag, tag.name)))
            except WrongAim:
                continue  # the type has no value out of range, so the fault does not change the tag

    def on(self, tag: str) -> ValueFault | None:
        return self if self.parameters.value is not None else self._of_tag.get(tag)

    def distort(self, value: float, since_s: float, held: float, random: Random) -> float:
        if self.parameters.value is None:
            raise Bug("the fault out-of-range without a value affects tags, and each has its own value")
        return float(self.parameters.value)
