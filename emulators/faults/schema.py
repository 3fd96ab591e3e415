"""A fault as given in a file or a scenario: its name, its target and its parameters.

faults:
  - {id: dead, name: silence, device: ctd, from: 5s, until: 12s}
  - {name: corrupt-crc, bus: line1, probability: 0.1}
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from fieldtwin.emulators.faults.fault import Aim, Fault, InjectionPoint
from fieldtwin.emulators.faults.registry import fault_class
from fieldtwin.emulators.faults.wrong_aim import WrongAim
from fieldtwin.gateway.core.errors import FileInvalid, UsageError
from fieldtwin.gateway.core.files.nearest import did_you_mean
from fieldtwin.gateway.core.files.yaml_file import Key, YamlFile, expected_value, load

_AIM_KEYS = tuple(info.alias or name for name, info in Aim.model_fields.items())
_NOT_OF = {
    InjectionPoint.BYTES: frozenset({"cob_id", "index"}),
    InjectionPoint.CAN: frozenset({"function", "address", "registers"}),
    InjectionPoint.VALUE: frozenset(_AIM_KEYS) - {"device", "register", "from", "until", "optional"},
}
"""By kind of fault: the keys of an aim that have no meaning for it."""


_DURATION = re.compile(r"^([0-9]+(?:\.[0-9]+)?)(ms|s|min|h)?$")
_UNIT_S = {"ms": 0.001, "s": 1.0, "": 1.0, "min": 60.0, "h": 3600.0}
MOST = 10_000


@dataclass(frozen=True, slots=True)
class FaultSpec:
    """A fault that may be injected. Times are in seconds of the run. If `until_s` is None, it is active until it is removed."""

    id: str
    kind: type[Fault]
    aim: Aim
    parameters: dict[str, Any]
    from_s: float
    until_s: float | None

    def make(self) -> Fault:
        """Return a new instance of the fault, because some faults keep state."""
        return self.kind(self.kind.form.model_validate(self.parameters))


def aims_of(kind: type[Fault]) -> list[str]:
    """Return the keys of an aim that have a meaning for this fault."""
    return [key for key in _AIM_KEYS if key not in _NOT_OF[kind.kind]]


def seconds(value: str | float | int) -> float:
    """Return the seconds of ``5s``, ``250ms``, ``2min``, ``24h``, or of a number of seconds. Raises `UsageError`."""
    if isinstance(value, int | float):
        return float(value)
    match = _DURATION.match(value.strip())
    if match is None:
        raise UsageError("a time", expected="5s, 250ms, 2min or 24h", got=repr(value))
    return float(match[1]) * _UNIT_S[match[2] or ""]


def parse_fault(
    said: dict[str, Any], file: YamlFile | None = None, loc: tuple[Key, ...] = (), number: int = 1
) -> FaultSpec:
    """Return one fault. Raises `FileInvalid` with its position in `file`, or `UsageError` if there is no file."""

    def wrong(key: str, message: str, *, expected: str = "", got: str = "", hint: str = "") -> FileInvalid | UsageError:
        if file is not None:
            return file.error((*loc, key) if key else loc, message, expected=expected, got=got, hint=hint)
        return UsageError(message, expected=expected, got=got, hint=hint)

    if not isinstance(said, dict):
        raise wrong("", "a fault", expected="{name: ..., device: ...}", got=repr(said)[:60])
    name = said.get("name")
    if not isinstance(name, str):
        raise wrong("", "a fault without a name", expected="name: one of those that `fieldtwin faults` lists")
    try:
        kind = fault_class(name)
    except UsageError as e:
        raise wrong("name", e.message, expected=e.expected, hint=e.hint) from e
    own = tuple(kind.form.model_fields)
    known = ("id", "name", *aims_of(kind), *own)
    for key in said:
        if key not in known:
            hint = did_you_mean(str(key), known)
            raise wrong(str(key), f"unknown key {key!r} in fault {name}", expected=", ".join(known), hint=hint)
    try:
        aim = Aim.model_validate({k: v for k, v in said.items() if k in _AIM_KEYS})
        parameters = {k: v for k, v in said.items() if k in own}
        kind.form.model_validate(parameters)
    except ValidationError as e:
        first = e.errors()[0]
        key = str(first["loc"][0]) if first["loc"] else ""
        words = re.findall(r"'([^']+)'", str(first.get("ctx", {}).get("expected", "")))
        hint = did_you_mean(str(first["input"]), words)
        expected = expected_value(first)
        what = key if expected else f"{key}: {first['msg']}"
        raise wrong(key, what, expected=expected, got=repr(first["input"])[:60], hint=hint) from e

    def time(key: str, value: str | float | int) -> float:
        try:
            return seconds(value)
        except UsageError as e:
            raise wrong(key, e.message, expected=e.expected, got=e.got) from e

    if aim.registers is not None:
        try:
            counted(aim.registers)
        except WrongAim as e:
            raise wrong("registers", e.message, expected=e.expected, got=e.got) from e
    from_s = time("from", aim.from_)
    until_s = None if aim.until is None else time("until", aim.until)
    if until_s is not None and until_s <= from_s:
        raise wrong("until", "the fault ends before it begins", expected="until after from")
    return FaultSpec(str(said.get("id") or f"{name}-{number}"), kind, aim, parameters, from_s, until_s)


Check = Callable[[FaultSpec], object]
"""A function that raises `WrongAim` for a fault that cannot be injected at this target."""


def load_faults(path: Path, check: Check | None = None) -> tuple[dict[str, Any], ...]:
    """Return the checked faults of a file in its order, each with an ID.

    Raises `FileInvalid` with the position in the file.
    """
    file = load(path)
    for key in file.data:
        if key != "faults":
            raise file.error((key,), f"unknown key {key!r}", expected="faults")
    said = file.data.get("faults")
    if not isinstance(said, list) or not said:
        raise file.error(("faults",), "a list of faults", expected="faults: [{name: ..., device: ...}]")
    if len(said) > MOST:
        raise file.error(("faults",), "too many faults", expected=f"at most {MOST}", got=str(len(said)))
    found: dict[str, dict[str, Any]] = {}
    for n, one in enumerate(said):
        spec = parse_fault(one, file, ("faults", n), n + 1)
        if check is not None:
            checked(check, spec, file, ("faults", n))
        if spec.id in found:
            raise file.error(("faults", n, "id"), f"the id {spec.id!r} is defined twice")
        found[spec.id] = {**one, "id": spec.id}
    return tuple(found.values())


def checked(check: Check, spec: FaultSpec, file: YamlFile, loc: tuple[Key, ...]) -> None:
    """Raise `FileInvalid` if `check` rejects the aim."""
    try:
        check(spec)
    except WrongAim as e:
        at = (*loc, e.key) if (*loc, e.key) in file.positions else loc
        raise file.error(at, e.message, expected=e.expected, got=e.got, hint=e.hint) from e


def counted(count: str | int | None) -> range | None:
    """Return the range of register or bit counts that a text such as ``40``, ``65..125`` or ``65..`` describes. Return None if
    the text is empty, which means every count. Raises `WrongAim`."""
    if count is None:
        return None
    low, dots, high = str(count).partition("..")
    try:
        first = int(low)
        last = first if not dots else int(high) if high else MOST_COUNTED
    except ValueError:
        first = last = 0
    if not 1 <= first <= last <= MOST_COUNTED:
        expected = f"1 to {MOST_COUNTED}, such as 40, 65..125 or 65.."
        raise WrongAim("registers", "a count of registers or bits", expected=expected, got=repr(count))
    return range(first, last + 1)


MOST_COUNTED = 2000
"""The largest number of bits that one request can read (AP 6.1)."""

FUNCTIONS_OF = {
    "coil": frozenset({1, 5, 15}),
    "discrete": frozenset({2}),
    "input": frozenset({4}),
    "holding": frozenset({3, 6, 16, 22, 23, 24}),
}
"""By table: the function codes that address it."""


def addressed(address: str | int) -> tuple[range, frozenset[int]]:
    """Return the PDU address of a text such as ``0x10`` or ``holding:0x10``, and the functions of its table.

    Raises `WrongAim`.
    """
    table, _, number = str(address).rpartition(":")
    try:
        at = int(number, 0)
    except ValueError:
        at = -1
    if not 0 <= at <= 0xFFFF or (table and table not in FUNCTIONS_OF):
        raise WrongAim("address", "an address", expected="a number, or holding:0x10", got=repr(address))
    return range(at, at + 1), FUNCTIONS_OF.get(table, frozenset())
