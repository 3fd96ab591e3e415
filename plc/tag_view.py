"""The process image as people see it: each tag with value, quality, source time, age, unit, limits, force, and what programs see.

Read between scans, from the image itself, so that what is shown is what the gateway gets. It must never know how it is asked
for, nor change anything.
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from fnmatch import fnmatchcase
from typing import Any

from gateway.core.image import INPUTS, OUTPUTS, Image, TagSpec
from gateway.core.values import Quality, TagValue
from plc.forces import Force
from plc.runner import Runner


def matches(tag: str, pattern: str) -> bool:
    """``ctd.pressure``, ``ctd.*``, ``*.state``, or ``ctd`` for all that is its."""
    return fnmatchcase(tag, pattern) or tag.startswith(f"{pattern}.")


class TagView:
    """Describes tags of an image that `runner` works on."""

    def __init__(self, image: Image, runner: Runner) -> None:
        self._runner = runner
        self._outputs = image.reader(OUTPUTS)
        self._specs = {region.name: {tag.name: tag for tag in region.tags} for region in image.layout.regions}

    def describe(self, patterns: Sequence[str], now_ns: int, utc_ns: int) -> list[dict[str, Any]]:
        """JSON-able: the tags that match one of `patterns` (see `matches`; all, without any), inputs first.

        `now_ns` is monotonic, the tags' clock, and `utc_ns` the same instant.
        """

        def wanted(tag: str) -> bool:
            return not patterns or any(matches(tag, p) for p in patterns)

        inputs = {tag: value for tag, value in self._runner.inputs().items() if wanted(tag)}
        snapshot = self._outputs.snapshot()
        outputs = {tag: snapshot.value(tag) for tag in self._specs[OUTPUTS] if wanted(tag)}
        seen = self._runner.seen_otherwise()
        forces = self._runner.forces
        rows = []
        for side, values, forced in ((INPUTS, inputs, forces.inputs), (OUTPUTS, outputs, forces.outputs)):
            for tag, value in values.items():
                row = _row(self._specs[side][tag], value, forced.get(tag), now_ns, utc_ns)
                row["side"] = side.removesuffix("s")
                row["seen"] = {
                    variable: {"value": as_seen.value, "quality": str(as_seen.quality)}
                    for variable, as_seen in (seen.get(tag, {}) if side == INPUTS else {}).items()
                }
                rows.append(row)
        return rows


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
        "limits": list(spec.limits) if spec.limits is not None else None,
        "forced": {"value": force.value, "by": force.by, "age_s": (now_ns - force.since_ns) / 1e9} if force else None,
    }
