"""The process image as users see it, and the variables of programs that are not tags.

Each tag has value, quality, source time, age, unit, limits, force, and the value that programs see. A variable that is not a
tag, such as ``control.delay.ET``, has the same keys, the side ``internal``, its IEC type, and no quality.

The values are read between scans, from the image itself, so that they are those that the gateway reads. This module must not
depend on how requests arrive, and must not change anything.
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from fnmatch import fnmatchcase
from itertools import islice
from typing import Any

from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.core.image.image import INPUTS, OUTPUTS, Image, TagSpec
from fieldtwin.gateway.core.values import Quality, TagValue
from fieldtwin.plc.cycle.forces import Force
from fieldtwin.plc.program import InternalVariable
from fieldtwin.plc.runtime.runner import TaskRunner

MAX_AT_ONCE = 64
"""The largest number of tags in one answer: a request between two scans must not delay the next one. Such an answer takes about
1 ms, including the encoding.
"""

MAX_INTERNAL = 1_000
"""The largest number of variables that are not tags in the list of names, for each program. Every other one can be named."""


def matches(tag: str, pattern: str) -> bool:
    """Return whether a tag matches a pattern: ``ctd.pressure``, ``ctd.*``, ``*.state``, or ``ctd`` for all tags of ``ctd``."""
    return fnmatchcase(tag, pattern) or tag.startswith(f"{pattern}.")


class TagView:
    """The view of the tags in the image that `runner` uses."""

    def __init__(self, image: Image, runner: TaskRunner) -> None:
        self._runner = runner
        self._outputs = image.reader(OUTPUTS)
        self._specs = {region.name: {tag.name: tag for tag in region.tags} for region in image.layout.regions}

    def names(self) -> list[str]:
        """Return every tag once, inputs first, without those of hidden variables."""
        hidden = self._runner.hidden_tags()
        return [name for name in self._specs[INPUTS] | self._specs[OUTPUTS] if name not in hidden]

    def internal_names(self) -> list[str]:
        """Return the variables that are not tags, at most `MAX_INTERNAL` of each program."""
        return [
            f"{bound.name}.{path}"
            for bound in self._runner.programs
            for path in islice(bound.program.internal_names(), MAX_INTERNAL)
        ]

    def _internal(self, name: str) -> dict[str, Any] | None:
        program, _, path = name.partition(".")
        for bound in self._runner.programs:
            if bound.name == program and (found := bound.program.internal(path)) is not None:
                return _internal_row(name, found)
        return None

    def describe(self, names: Sequence[str], now_ns: int, utc_ns: int) -> list[dict[str, Any]]:
        """Return the tags as data for JSON, in the order of `names`. A tag that is in both regions has two entries, the input
        first.

        Raises `UsageError` for more than `MAX_AT_ONCE` tags, or for an unknown one. `now_ns` is monotonic, the tags'
        clock, and `utc_ns` the same instant.
        """
        if len(names) > MAX_AT_ONCE:
            raise UsageError("too many tags at once", expected=f"at most {MAX_AT_ONCE}", got=str(len(names)))
        runner, snapshot, rows = self._runner, self._outputs.snapshot(), []
        for name in names:
            row = {}
            if spec := self._specs[INPUTS].get(name):
                row = _row(runner.as_limited(spec), runner.input(name), runner.forces.inputs.get(name), now_ns, utc_ns)
                seen = {
                    variable: {"value": as_seen.value, "quality": str(as_seen.quality)}
                    for variable, as_seen in runner.substituted_values(name).items()
                }
                rows.append({**row, "side": "input", "seen": seen})
            if spec := self._specs[OUTPUTS].get(name):
                value = snapshot.value(name)
                # after an online change, a variable of another type may have the name of a tag that no longer has a value
                replaced = self._internal(name) if value.value is None else None
                row = replaced or {
                    **_row(runner.as_limited(spec), value, runner.forces.outputs.get(name), now_ns, utc_ns),
                    "side": "output",
                    "seen": {},
                }
                rows.append(row)
            if not row:
                row = self._internal(name) or {}
                if not row:
                    raise UsageError(f"no tag or variable {name!r}", expected="one that `fieldtwin plc watch` lists")
                rows.append(row)
        return rows


def _internal_row(name: str, found: InternalVariable) -> dict[str, Any]:
    return {
        "tag": name,
        "kind": found.type,
        "value": found.value,
        "quality": None,
        "reason": "none",
        "age_s": None,
        "time": None,
        "unit": "ns" if found.type in ("TIME", "LTIME") else "",
        "words": {},
        "value_names": {},
        "limits": None,
        "forced": None,
        "side": "internal",
        "seen": {},
    }


def _row(spec: TagSpec, value: TagValue, force: Force | None, now_ns: int, utc_ns: int) -> dict[str, Any]:
    if force is not None:
        value = TagValue(force.value, Quality.SIMULATED, t_ns=force.since_ns)
    time_ns = utc_ns - now_ns + value.t_ns
    return {
        "tag": spec.name,
        "kind": spec.kind.value,
        **value.describe(now_ns),
        "time": datetime.fromtimestamp(time_ns / 1e9, UTC).isoformat(timespec="milliseconds") if value.t_ns else None,
        "unit": spec.unit,
        "words": dict(spec.words),
        "value_names": dict(spec.value_names),
        "limits": list(spec.limits) if spec.limits is not None else None,
        "forced": {"value": force.value, "by": force.by, "age_s": (now_ns - force.since_ns) / 1e9} if force else None,
    }
