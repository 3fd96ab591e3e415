"""The progress of a scenario's run, read from the lines that ``fieldtwin test --progress FILE`` writes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec

AT_ONCE_BYTES = 1 << 20
MOST_VALUES = 20_000
"""The largest number of values that are kept: as many as a run writes."""
MOST_LINE_BYTES = 1 << 20


class RunProgress:
    """Steps, checks and values of one run. `look` reads what the run has written since the last call."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._read_to = 0
        self._rest = b""
        self._steps: list[dict[str, Any]] = []
        self._checks: list[dict[str, Any]] = []
        self._values: list[list[Any]] = []
        self._t_s = 0.0

    def look(self) -> bool:
        """Read the next new lines, and return whether there were any. A file that does not exist yet has no lines."""
        try:
            with self._path.open("rb") as file:
                file.seek(self._read_to)
                chunk = file.read(AT_ONCE_BYTES)
        except OSError:
            return False
        self._read_to += len(chunk)
        *lines, self._rest = (self._rest + chunk).split(b"\n")
        self._rest = self._rest[:MOST_LINE_BYTES]
        for line in lines:
            try:
                self._take(msgspec.json.decode(line, type=dict[str, Any]))
            except (msgspec.MsgspecError, KeyError):
                continue  # the result of the run does not depend on these lines
        return bool(chunk)

    def state(self, values_from: int) -> dict[str, Any]:
        """Return steps and checks with their verdicts, the latest time in s, and the values from number `values_from` on."""
        return {
            "t_s": self._t_s,
            "steps": self._steps,
            "checks": self._checks,
            "values_from": values_from,
            "values_total": len(self._values),
            "values": self._values[values_from:],
        }

    def _take(self, line: dict[str, Any]) -> None:
        self._t_s = max(self._t_s, line.get("t_s", 0.0))
        match line["event"]:
            case "scenario":
                self._steps = [{**step, "begun_s": None, "t_s": None, "verdict": ""} for step in line["steps"]]
                self._checks = [{**check, "t_s": None, "verdict": ""} for check in line["checks"]]
                self._values, self._t_s = [], 0.0
            case "step":
                self._of(self._steps, line)["begun_s"] = line["t_s"]
            case "verdict":
                number = line["number"]
                among = self._steps if number in (step["number"] for step in self._steps) else self._checks
                self._of(among, line).update(t_s=line.get("t_s"), verdict=line["verdict"])
            case "value" if len(self._values) < MOST_VALUES:
                self._values.append([line[key] for key in ("name", "t_s", "value", "quality", "reason")])

    @staticmethod
    def _of(among: list[dict[str, Any]], line: dict[str, Any]) -> dict[str, Any]:
        """Return the step or check in `among` that a line is about; add it if it is new."""
        for one in among:
            if one["number"] == line["number"]:
                return one
        among.append({"number": line["number"], "text": line.get("text", ""), "t_s": None, "verdict": ""})
        return among[-1]
