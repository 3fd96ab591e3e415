"""The state of a program: its variables that keep their values between scans, and the values that each of them can have."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import z3

from fieldtwin.plc.st.model_checking.execution import floats
from fieldtwin.plc.st.model_checking.execution.mailboxes import Model
from fieldtwin.plc.st.model_checking.execution.merging import options_of
from fieldtwin.plc.st.model_checking.execution.operations import is_none
from fieldtwin.plc.st.model_checking.execution.refusal import NotModelled
from fieldtwin.plc.st.model_checking.execution.symbolic import (
    TEXT,
    Choice,
    Int,
    Text,
    Undefined,
    as_condition,
    bits_of,
    is_condition,
    is_integer,
    limits,
    made,
    negated,
    width,
)
from fieldtwin.plc.st.runtime.layouts import Stored
from fieldtwin.plc.st.runtime.lines import is_line
from fieldtwin.plc.st.runtime.references import REFERENCES, Instance


@dataclass(frozen=True, slots=True)
class Leaf:
    """A variable that keeps its value: an attribute of the object `owner`, or an element of the list `owner`."""

    owner: Any
    key: Any
    name: str

    @property
    def is_time(self) -> bool:
        """Return whether the value is a time of the clock, of which only the distance from the present scan matters."""
        return isinstance(self.key, str) and self.key.startswith("_") and self.key.endswith("_ns")

    def get(self) -> Any:
        return self.owner[self.key] if isinstance(self.owner, list) else getattr(self.owner, self.key)

    def put(self, value: Any) -> None:
        if isinstance(self.owner, list):
            self.owner[self.key] = value
        else:
            setattr(self.owner, self.key, value)


def leaves(owner: Any, name: str = "") -> Iterator[Leaf]:
    """Return every variable below `owner`. References of VAR_IN_OUTs are left out, because each call assigns them first."""
    for key, value in _parts(owner):
        path = f"{name}[{key}]" if isinstance(owner, list) else f"{name}.{key}" if name else key
        if isinstance(value, list) or _is_object(value):
            yield from leaves(value, path)
        else:
            yield Leaf(owner, key, path)


def objects(owner: Any) -> Iterator[Any]:
    """Return `owner` and every object below it."""
    if not isinstance(owner, list):
        yield owner
    for _, value in _parts(owner):
        if isinstance(value, list) or _is_object(value):
            yield from objects(value)


def _parts(owner: Any) -> list[tuple[Any, Any]]:
    if isinstance(owner, list):
        return list(enumerate(owner))
    slots = [name for kind in type(owner).__mro__ for name in getattr(kind, "__slots__", ())]
    names = slots or list(vars(owner))
    references = getattr(owner, "in_outs", ())
    return [(name, getattr(owner, name)) for name in names if name not in references and not is_line(name)]


def _is_object(value: Any) -> bool:
    """Return whether a value is an object with variables. References do not count."""
    plain = (
        bool | int | float | str | tuple | Text | Int | Choice | floats.Float | z3.AstRef | Instance | Stored | Model
    )
    return value is not None and not isinstance(value, plain) and not isinstance(value, REFERENCES)


@dataclass(frozen=True, slots=True)
class Domain:
    """The values that a variable can have: None, truth values, integers from `low` to `high`, numbers, or texts.

    `number` is "" for no number, "single" or "double" for any number, or the text of the only number.
    `text` is the only text, or `TEXT` for any.
    """

    none: bool = False
    truths: frozenset[bool] = frozenset()
    low: int | None = None
    high: int | None = None
    number: str = ""
    text: str | Text | None = None

    @classmethod
    def of(cls, value: Any) -> Domain:
        """Return the values that a symbolic value can have."""
        found = cls()
        for _, option in options_of(value):
            found = found.joined(cls._of_option(option))
        return found

    @classmethod
    def _of_option(cls, value: Any) -> Domain:
        if value is None:
            return cls(none=True)
        if isinstance(value, Undefined):
            return cls()
        if is_condition(value):
            return cls(truths=frozenset([value] if isinstance(value, bool) else [False, True]))
        if is_integer(value):
            low, high = limits(value)
            return cls(low=low, high=high)
        if floats.is_float(value):
            if isinstance(value, float):
                return cls(number=repr(value))
            return cls(number="single" if value.single else "double")
        if isinstance(value, str | Text):
            return cls(text=value)
        if isinstance(value, Instance):
            raise NotModelled("a variable of an interface type")
        if isinstance(value, REFERENCES):
            raise NotModelled("a reference or pointer that keeps its value")
        if isinstance(value, Stored):
            raise NotModelled("a union")
        raise NotModelled(f"a variable of the type {type(value).__name__}")

    def joined(self, other: Domain) -> Domain:
        low = self.low if other.low is None else other.low if self.low is None else min(self.low, other.low)
        high = self.high if other.high is None else other.high if self.high is None else max(self.high, other.high)
        text = other.text if self.text is None or self.text == other.text else self.text if other.text is None else TEXT
        number = self._number(other)
        return Domain(self.none or other.none, self.truths | other.truths, low, high, number, text)

    def _number(self, other: Domain) -> str:
        kinds = {self.number, other.number} - {""}
        if len(kinds) < 2:
            return next(iter(kinds), "")
        singles = all(kind == "single" or (kind != "double" and floats.fits_single(float(kind))) for kind in kinds)
        return "single" if singles else "double"

    def within(self, low: int, high: int) -> Domain:
        return replace(self, low=low, high=high)

    def symbol(self, name: str) -> Symbol:
        """Return a symbolic value with any value of the domain."""
        if self.text is not None:
            return Symbol(self.text, (), True)
        variables: list[Any] = []
        limited: Any = True
        value: Any = None
        if self.truths:
            if len(self.truths) == 1:
                (value,) = self.truths
            else:
                value = z3.Bool(name)
                variables.append(value)
        elif self.low is not None and self.high is not None:
            value, limited = integer(name, self.low, self.high)
            if isinstance(value, Int):
                variables.append(value.expr)
        elif self.number in ("single", "double"):
            value = floats.Float(z3.FP(name, _sort(self.number)), self.number == "single")
            variables.append(value.expr)
        elif self.number:
            value = float(self.number)
        if self.none and value is not None:
            absent = z3.Bool(f"{name} is absent")
            variables.insert(0, absent)
            value = Choice(((absent, None), (negated(absent), value)))
        return Symbol(value, tuple(variables), limited)

    def encoded(self, value: Any) -> list[Any]:
        """Return the expressions of `value`, one for each variable of `symbol`."""
        if self.text is not None:
            return []
        found: list[Any] = []
        payload = next((o for _, o in options_of(value) if o is not None and not isinstance(o, Undefined)), None)
        if len(self.truths) == 2:
            found.append(as_condition(False if payload is None else payload))
        elif self.low is not None and self.high is not None and self.low < self.high:
            found.append(bits_of(self.low if payload is None else payload, width(self.low, self.high)))
        elif self.number in ("single", "double"):
            number = 0.0 if payload is None else payload
            found.append(floats.single(number) if self.number == "single" else floats.double(number))
        if self.none and (self.truths or self.low is not None or self.number):
            found.insert(0, as_condition(is_none(value)))
        return found


@dataclass(frozen=True, slots=True)
class Symbol:
    """A symbolic value, its variables in the solver, and the condition that limits them."""

    value: Any
    variables: tuple[Any, ...]
    limited: Any


def integer(name: str, low: int, high: int) -> tuple[Any, Any]:
    """Return an integer with any value from `low` to `high`, and the condition that limits its variable."""
    if low == high:
        return low, True
    bits = width(low, high)
    variable = z3.BitVec(name, bits)
    limited: Any = True
    if (low, high) != (-(1 << (bits - 1)), (1 << (bits - 1)) - 1):
        limited = z3.And(variable >= low, variable <= high)
    return made(variable, low, high), limited


def _sort(number: str) -> Any:
    return z3.Float32() if number == "single" else z3.Float64()
