"""Find the profile that fits a device, with certainty and reasons. The functions do no I/O: they rank profiles by clues.

Certainty requires an unambiguous identification by the device itself: its identity objects (2Bh/0Eh), its vendor ID and
product code (1018h), or the SunSpec header and a model number. Readable and plausible registers never make a profile certain:
sister models share maps, and an empty register is plausible everywhere.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum

from fieldtwin.gateway.core.files.profile import DeviceProfile, Tag
from fieldtwin.gateway.core.values import Quality, TagValue
from fieldtwin.gateway.protocols.canopen.configure import Identity
from fieldtwin.gateway.protocols.canopen.eds.dictionary import ObjectDictionary

ENOUGH_SIGNS = 6
"""Number of plausible values (only those count that could also have been implausible) from which on a profile is likely
to fit.
"""
TELLING_BYTES = 4
"""A server ID shorter than this many bytes is shared by many devices, so it identifies none."""
_SUNSPEC_PROFILE = re.compile(r"^sunspec/.*-(\d+)$")


class Sureness(IntEnum):
    """The certainty with which a profile fits, in rising order."""

    RULED_OUT = 0
    POSSIBLE = 1
    LIKELY = 2
    CERTAIN = 3

    def __str__(self) -> str:
        return self.name.lower().replace("_", " ")


@dataclass(frozen=True, slots=True)
class SunSpec:
    """A SunSpec map: its base, and its models as (number, address of the number, number of registers after its length)."""

    base: int
    models: tuple[tuple[int, int, int], ...]
    manufacturer: str = ""
    model: str = ""
    version: str = ""
    serial: str = ""


@dataclass(slots=True)
class ModbusClues:
    """The data with which a unit identifies itself. A value is None if the unit did not give it; `silence` has the reason, by
    function, such as ``"2B"``.
    """

    server_id: bytes | None = None
    objects: dict[int, str] | None = None
    sunspec: SunSpec | None = None
    silence: dict[str, str] = field(default_factory=dict)


@dataclass(slots=True)
class CanClues:
    """The data with which a node identifies itself. `silence` has the reasons for missing values, by object."""

    identity: Identity | None = None
    name: str = ""
    hardware: str = ""
    software: str = ""
    silence: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Candidate:
    """A profile, the certainty that it fits, and the reasons for and against it."""

    profile: str
    sureness: Sureness
    reasons: tuple[str, ...]
    against: tuple[str, ...] = ()
    signs: int = 0


@dataclass(frozen=True, slots=True)
class ProfileReading:
    """A tag that was read for a profile: its value, or the problem. `refused`: the device refused the read."""

    tag: Tag
    value: TagValue | None
    problem: str = ""
    refused: bool = False


def rank(candidates: Iterable[Candidate]) -> list[Candidate]:
    """Sort the candidates, best first."""
    return sorted(candidates, key=lambda c: (-c.sureness, -c.signs, c.profile))


def certain(ranked: Sequence[Candidate]) -> str | None:
    """Return the profile that is certain; None if no profile or more than one is certain."""
    found = [c.profile for c in ranked if c.sureness is Sureness.CERTAIN]
    return found[0] if len(found) == 1 else None


def summary(ranked: Sequence[Candidate]) -> str:
    """Return the result as a cautious sentence: if several profiles fit equally well, it names all of them."""
    best = [c for c in ranked if c.sureness is not Sureness.RULED_OUT and c.sureness == ranked[0].sureness]
    if not best:
        return "no known profile fits"
    names = ", ".join(c.profile for c in best)
    if len(best) > 1:
        return f"{len(best)} profiles fit equally well ({best[0].sureness}): {names}"
    return f"{names}: {best[0].sureness}"


# -- Modbus -----------------------------------------------------------------------------------------------------------


def contradicted(profile: DeviceProfile, clues: ModbusClues) -> str:
    """Return why `profile` contradicts the unit's identification; empty if it does not. If it does, the profile's registers
    need not be read.
    """
    if clues.objects is not None:
        for number, label in ((0, "vendor"), (1, "product code")):
            stated, told = profile.form.identification.get(number), clues.objects.get(number)
            if stated is not None and told is not None and stated.strip() != told.strip():
                return f"its {label} is {told!r}, not {stated!r}"
    model = _SUNSPEC_PROFILE.match(profile.name)
    if model is not None and clues.sunspec is None and clues.silence.get("sunspec") == "no header":
        return "it has no SunSpec header"
    if model is not None and clues.sunspec is not None and int(model[1]) not in [m[0] for m in clues.sunspec.models]:
        return f"it has no SunSpec model {model[1]}"
    return ""


def rate_modbus(profile: DeviceProfile, clues: ModbusClues, readings: Mapping[str, ProfileReading]) -> Candidate:
    """Return the certainty that the unit is a device of `profile`, with the reasons.

    `readings` are the values of the tags in the profile's `identify` section, and of other tags, by name.
    """
    against = contradicted(profile, clues)
    if against:
        return Candidate(profile.name, Sureness.RULED_OUT, (), (against,))
    reasons, doubts, certain = _own_words(profile, clues, readings)
    keyed, wrong = _keys(profile, readings)
    if wrong:
        return Candidate(profile.name, Sureness.RULED_OUT, tuple(reasons), tuple(wrong))
    keys = {entry.tag for entry in profile.form.identify}
    others = [r for name, r in readings.items() if name not in keys]
    signs, nonsense = _plausibility(others)
    if 4 * len(nonsense) > len(signs) + len(keyed) and not certain:
        return Candidate(profile.name, Sureness.RULED_OUT, tuple(reasons), tuple(nonsense[:3]))
    doubts += nonsense
    reasons += keyed
    if signs:
        some = ", ".join(signs[:3]) + ("..." if len(signs) > 3 else "")
        reasons.append(f"{len(signs)} value{'s' * (len(signs) > 1)} that could be nonsense and are not ({some})")
    total = len(signs) + len(keyed)
    if certain:
        sureness = Sureness.CERTAIN
    elif any("11h" in r for r in reasons) or total >= ENOUGH_SIGNS:
        sureness = Sureness.LIKELY
    elif total:
        sureness = Sureness.POSSIBLE
    else:
        return Candidate(profile.name, Sureness.RULED_OUT, (), ("no value that was read supports it",))
    return Candidate(profile.name, sureness, tuple(reasons), tuple(doubts), total)


def _own_words(
    profile: DeviceProfile, clues: ModbusClues, readings: Mapping[str, ProfileReading]
) -> tuple[list[str], list[str], bool]:
    """Compare the unit's identification with that in `profile`. Return reasons for, doubts, and whether the reasons prove it."""
    reasons: list[str] = []
    doubts: list[str] = []
    certain = False
    stated = profile.form.identification
    if {0, 1} <= stated.keys():
        if clues.objects is None:
            doubts.append("it does not report the identity (2Bh/0Eh) that the profile states")
        elif all(clues.objects.get(n, "").strip() == stated[n].strip() for n in (0, 1)):
            certain = bool(stated[0].strip() and stated[1].strip())
            reasons.append(f"vendor {stated[0]!r} and product code {stated[1]!r} as stated (2Bh/0Eh)")
    if profile.form.server_id is not None and clues.server_id is not None:
        known, more = bytes.fromhex(profile.form.server_id), bytes.fromhex(profile.form.server_data)
        # A run indicator may follow, and data after it (AP 6.13).
        same = clues.server_id in (known, *(known + indicator + more for indicator in (b"\x00", b"\xff")))
        if same and len(known) >= TELLING_BYTES:
            reasons.append("its server id (11h) is the profile's")
        elif not same:
            doubts.append("its server id (11h) is different")
    model = _SUNSPEC_PROFILE.match(profile.name)
    if model is not None and clues.sunspec is not None:
        where = _model_holds(profile, clues.sunspec, int(model[1]))
        if where:
            certain = True
            reasons.append(f"SunSpec header at {clues.sunspec.base}, {where}: the standard map, for any maker")
        else:
            doubts.append(f"its SunSpec model {model[1]} has different addresses from the profile's")
    elif model is not None:
        doubts.append("its SunSpec header cannot be read")
    return reasons, doubts, certain


def _model_holds(profile: DeviceProfile, found: SunSpec, number: int) -> str:
    """Return ``model N`` if all registers of the profile lie in SunSpec blocks of the device, else an empty string.

    These blocks are the device's model 1, its model `number`, and the marks around all models ("SunS" and the end model).
    """
    blocks = [(at, at + 2 + size) for n, at, size in found.models if n in (1, number)]
    end = max((at + 2 + size for _, at, size in found.models), default=found.base)
    blocks += [(found.base, found.base + 2), (end, end + 2)]
    tags = [t.at for t in profile.tags.values() if t.at is not None]
    inside = all(any(a <= r.address and r.end <= b for a, b in blocks) for r in tags)
    return f"model {number}" if inside and tags else ""


def _keys(profile: DeviceProfile, readings: Mapping[str, ProfileReading]) -> tuple[list[str], list[str]]:
    """Check the entries in the profile's `identify` section. Return reasons for, and contradictions that rule the profile out."""
    good: list[str] = []
    wrong: list[str] = []
    for entry in profile.form.identify:
        reading = readings.get(entry.tag)
        if reading is None or (reading.value is None and not reading.refused):
            continue  # the reply was lost in transit, so it is no evidence
        value = reading.value.value if reading.value is not None else None
        if value is None:
            wrong.append(f"{entry.tag} cannot be read: {reading.problem or 'no value'}")
        elif entry.expect is not None:
            same = str(value).strip() == str(entry.expect).strip()
            (good if same else wrong).append(f"{entry.tag} is {value!r}" + ("" if same else f", not {entry.expect!r}"))
        elif entry.between is not None and isinstance(value, int | float):
            low, high = entry.between
            inside = low <= value <= high
            (good if inside else wrong).append(
                f"{entry.tag} is {value:g}, {'inside' if inside else 'not'} {low:g} to {high:g}"
            )
        elif isinstance(value, str):
            text = value.strip()
            if len(text) >= 2 and text.isascii() and text.isprintable():
                good.append(f"{entry.tag} reads {text!r}")
            else:
                wrong.append(f"{entry.tag} is not a text: {value!r}")
    return good, wrong


def _plausibility(readings: Iterable[ProfileReading]) -> tuple[list[str], list[str]]:
    """Return the names of tags with a plausible value that could have been implausible, and the implausible values."""
    signs: list[str] = []
    nonsense: list[str] = []
    for reading in readings:
        verdict = _sense(reading)
        if verdict > 0:
            signs.append(reading.tag.name)
        elif verdict < 0:
            nonsense.append(_shown(reading))
    return signs, nonsense


def _sense(reading: ProfileReading) -> int:
    """Return 1 for a plausible value that could have been implausible, -1 for an implausible one, 0 for no evidence."""
    tag = reading.tag
    if reading.value is None:
        return -1 if reading.refused else 0
    value = reading.value.value
    if value is None or reading.value.quality is Quality.BAD:
        return 0
    if tag.is_text:
        return 0
    assert isinstance(value, int | float)
    if tag.type in ("float32", "float64") and tag.scale == 1.0:
        if value == 0:
            return 0
        return 1 if math.isfinite(value) and 1e-6 <= abs(value) <= 1e9 else -1
    if tag.values:
        return (1 if value else 0) if int(value) in dict(tag.values) else -1
    if tag.range is not None:
        return (1 if value else 0) if tag.range[0] <= value <= tag.range[1] else -1
    return 0


def _shown(reading: ProfileReading) -> str:
    if reading.value is None:
        return f"{reading.tag.name} cannot be read: {reading.problem}"
    return f"{reading.tag.name} would be {reading.value.value!r}"


# -- CANopen ----------------------------------------------------------------------------------------------------------


def rate_canopen(profile: DeviceProfile, eds: ObjectDictionary | None, clues: CanClues) -> Candidate:
    """Return the certainty that the node is a device of `profile`, whose data sheet is `eds`, with the reasons."""
    told = clues.identity
    if eds is None or told is None:
        return Candidate(profile.name, Sureness.RULED_OUT, (), ("there is nothing to compare",))
    entry = eds.get(0x1000)
    kind = entry.default if entry is not None and isinstance(entry.default, int) else None
    reasons: list[str] = []
    against: list[str] = []
    if kind is not None:
        if kind == told.device_type:
            reasons.append(f"device type {kind:08X}h")
        elif kind & 0xFFFF == told.device_type & 0xFFFF and kind & 0xFFFF:
            reasons.append(
                f"the same device profile (CiA {kind & 0xFFFF}), but a different type of it: {told.device_type:08X}h"
            )
        else:
            against.append(f"its device type is {told.device_type:08X}h, not {kind:08X}h")
    same_vendor = told.vendor is not None and told.vendor == eds.vendor_number
    same_product = told.product is not None and told.product == eds.product_number
    if told.vendor is not None and eds.vendor_number is not None and not same_vendor:
        against.append(f"its vendor is {told.vendor:X}h, not {eds.vendor_number:X}h")
    if same_vendor and told.product is not None and eds.product_number is not None and not same_product:
        against.append(f"its product is {told.product:X}h, not {eds.product_number:X}h")
    if same_vendor and same_product and not against:
        reasons.append(f"vendor {told.vendor:X}h and product {told.product:X}h as in its data sheet (1018h)")
        if told.vendor:
            return Candidate(profile.name, Sureness.CERTAIN, tuple(reasons), (), 3)
        return Candidate(profile.name, Sureness.LIKELY, tuple(reasons), ("vendor ID 0 is not assigned",), 2)
    exact = kind is not None and kind == told.device_type and bool(kind & 0xFFFF)
    if exact and not any("device type" in a for a in against):
        doubt = ("a different maker's device of the same kind: the standard objects fit, the maker's objects may not",)
        return Candidate(profile.name, Sureness.POSSIBLE, tuple(reasons), (*against, *doubt), 1)
    return Candidate(profile.name, Sureness.RULED_OUT, tuple(reasons), tuple(against) or ("no value supports it",))
