"""What `fieldtwin plc` shows: tables on a terminal, the same as plain lines elsewhere."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from rich.live import Live
from rich.table import Table

from fieldtwin.cli.talk import data, talk
from gateway.core.control import ControlClient
from gateway.core.errors import UsageError
from plc.prove import Proof, Result

REFRESH_S = 0.25


@dataclass(frozen=True, slots=True)
class TagRow:
    """One tag as it is shown. `age_ms` None where a tag has none (outputs)."""

    tag: str
    value: Any
    quality: str
    age_ms: float | None
    side: str
    forced: bool

    def describe(self) -> dict[str, Any]:
        return {
            "value": self.value,
            "quality": self.quality,
            "age_ms": self.age_ms,
            "side": self.side,
            "forced": self.forced,
        }


def tag_rows(status: dict[str, Any], patterns: tuple[str, ...]) -> list[TagRow]:
    """The tags that match, outputs after inputs. Raises `UsageError` for a pattern that nothing matches."""
    forced = status["forces"]
    rows = []
    for tag, seen in status["inputs"].items():
        quality = f"{seen['quality']}{': ' + seen['reason'] if seen.get('reason') not in (None, '', 'none') else ''}"
        value = forced[tag]["value"] if tag in forced and tag not in status["outputs"] else seen.get("value")
        rows.append(
            TagRow(tag, value, quality, seen.get("age_ms"), "input", tag in forced and tag not in status["outputs"])
        )
    rows += [TagRow(tag, value, "", None, "output", tag in forced) for tag, value in status["outputs"].items()]
    if not patterns:
        return rows
    for pattern in patterns:
        if not any(fnmatchcase(row.tag, pattern) for row in rows):
            raise UsageError(f"no tag {pattern!r}", expected=", ".join(r.tag for r in rows[:12]))
    return [row for row in rows if any(fnmatchcase(row.tag, p) for p in patterns)]


def tag_table(rows: list[TagRow]) -> Table:
    table = Table(box=None, pad_edge=False)
    for name, justify in (("tag", "left"), ("value", "right"), ("quality", "left"), ("age", "right"), ("", "left")):
        table.add_column(name, justify=justify, no_wrap=name != "quality")  # type: ignore[arg-type]
    for row in rows:
        style = "yellow" if row.forced else "red" if row.quality.startswith("bad") else ""
        age = "" if row.age_ms is None else _age(row.age_ms)
        table.add_row(row.tag, _value(row.value), row.quality, age, "FORCED" if row.forced else row.side, style=style)
    return table


def print_tags(rows: list[TagRow]) -> None:
    data.print(tag_table(rows))


async def watch_live(path: Path, patterns: tuple[str, ...]) -> None:
    client = await ControlClient.connect_unix(path)
    try:
        with Live(console=data, auto_refresh=False, transient=True) as live:
            while True:
                live.update(tag_table(tag_rows(await client.call("get"), patterns)), refresh=True)
                await asyncio.sleep(REFRESH_S)
    finally:
        await client.aclose()


def print_status(status: dict[str, Any]) -> None:
    head = f"{status['state']}"
    if status["stop_reason"] != "none":
        head += f" ({status['stop_reason']})"
    if status["restart_in_ms"] is not None:
        head += f", restarts in {status['restart_in_ms'] / 1000:.1f} s"
    data.print(f"PLC: {head}", markup=False)
    if status["error"]:
        data.print(f"  {status['error']}", markup=False, soft_wrap=True)
    data.print(f"gateway: {'alive' if status['gateway_alive'] else 'DEAD: every input is bad'}", markup=False)
    table = Table(box=None, pad_edge=False)
    for name in ("task", "every", "scans", "missed", "overrun", "late p50", "p99", "max", "takes p50", "p99", "max"):
        table.add_column(name, justify="left" if name == "task" else "right", no_wrap=True)
    for name, task in status["tasks"].items():
        late, took = task["lateness_us"], task["duration_us"]
        every = f"on {task['single']}" if task["single"] else f"{task['cycle_ms']:g} ms"
        table.add_row(
            name, every, str(task["scans"]), str(task["missed_periods"]), str(task["overruns"]),
            *(_us(late[k]) for k in ("p50", "p99", "max")), *(_us(took[k]) for k in ("p50", "p99", "max")),
        )  # fmt: skip
    data.print(table)
    data.print(f"restarts: {status['restarts']}; {status['retain']['start']}", markup=False)
    granted, refused = status["realtime"]["granted"], status["realtime"]["refused"]
    data.print("granted: " + (", ".join(granted) or "nothing"), markup=False, soft_wrap=True)
    if refused:
        data.print("refused: " + ", ".join(f"{k} ({v})" for k, v in refused.items()), markup=False, soft_wrap=True)
    counters = {name: count for name, count in status["counters"].items() if count}
    if counters:
        data.print("counted: " + ", ".join(f"{n} {c}" for n, c in counters.items()), markup=False)
    if status["forces"]:
        data.print(f"FORCED: {len(status['forces'])}", style="yellow")
        for tag, force in status["forces"].items():
            by = f" by {force['by']}" if force["by"] else ""
            data.print(f"  {tag} = {force['value']}{by}, {_age(force['age_ms'])} ago", style="yellow", markup=False)
    else:
        data.print("nothing is forced")


def print_why(tag: str, changes: list[dict[str, Any]]) -> None:
    if not changes:
        data.print(f"{tag} has not changed since the programs began", markup=False)
    for change in changes:
        by = "a force, through" if change["forced"] else ""
        data.print(
            f"{_age(change['age_ms'])} ago, scan {change['scan']}: {_value(change['before'])} to {_value(change['after'])}, "
            f"by {by + ' ' if by else ''}program {change['program']}",
            markup=False,
        )
        for name, value in change["inputs"].items():
            data.print(f"    {name} was {_value(value)}", markup=False)


def print_proof(name: str, proof: Proof, result: Result, text: str) -> None:
    seen = f"{result.states} states, {result.transitions} scans, {result.depth} deep"
    if result.proved:
        data.print(f"{name}: proved over {seen}", markup=False)
        for invariant in proof.invariants:
            data.print(f"  holds: {invariant}", markup=False)
    elif result.broken:
        data.print(f"{name}: broken after {len(result.way)} scans: {result.broken}", markup=False)
        data.print(text, markup=False, end="")
    else:
        data.print(f"{name}: nothing broken in {seen}, but not everything was seen: no proof", markup=False)
        talk.print("raise --max-states")


def _us(us: float) -> str:
    return f"{us:.0f}us" if us < 10_000 else f"{us / 1000:.1f}ms"


def _age(ms: float) -> str:
    return f"{ms:.0f} ms" if ms < 10_000 else f"{ms / 1000:.0f} s" if ms < 600_000 else f"{ms / 60_000:.0f} min"


def _value(value: Any) -> str:
    return "-" if value is None else f"{value:.6g}" if isinstance(value, float) else str(value)
