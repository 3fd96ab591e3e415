"""The output of `fieldtwin plc`: tables on a terminal, plain lines elsewhere."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Mapping
from itertools import count
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.live import Live
from rich.table import Table
from rich.text import Text

from fieldtwin.console import stdout
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.control import ControlClient, RemoteError
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.plc.runtime.tag_view import MAX_AT_ONCE, matches
from fieldtwin.plc.status import PlcStatus, RealtimeStatus, WaitingStatus
from fieldtwin.run.processes.plc_client import running_instances

REFRESH_S = 0.25
NAMES_EVERY = 8
"""After so many refreshes the live table reads the names of the variables again, because an online change may add some."""
IN_A_PIPE = 500
ROOM_FOR_LIMITS = 100
"""A terminal with at least this many columns also shows the limits."""
_WHOLE_TYPES = {
    span
    for bits in (8, 16, 32, 64)
    for span in ((0, 2**bits - 1), (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1), (0, 2.0**bits))
}

_SIDES = ("input", "output", "internal")
AT_TIMEOUT = {
    "wait": "reported as an error after {:g} s",
    "stop": "the PLC stops after {:g} s",
    "start_anyway": "it starts anyway after {:g} s",
}

Row = dict[str, Any]
"""A tag as the PLC's `image` command describes it."""


async def chosen_tags(client: ControlClient, patterns: tuple[str, ...]) -> list[str]:
    """Return the names that match. Raises `UsageError` for a pattern without a match."""
    answer = await client.call("image")
    names: list[str] = [*answer["names"], *answer["internal"]]
    elements = [pattern for pattern in patterns if "[" in pattern]  # not listed, and no pattern
    for pattern in patterns:
        if pattern not in elements and not any(matches(name, pattern) for name in names):
            if pattern in running_instances():
                raise UsageError(
                    f"{pattern!r} is a running instance, not a tag", expected=f"--instance {pattern}, and tags"
                )
            raise UsageError(f"no tag {pattern!r}", expected=", ".join(names[:12]) + (", ..." if names[12:] else ""))
    listed = [name for name in names if not patterns or any(matches(name, p) for p in patterns)]
    return listed + [element for element in elements if element not in listed]


async def ask_rows(client: ControlClient, names: list[str]) -> list[Row]:
    """Read rows of tags from the PLC, a few at a time, so that no scan is delayed; return rows of inputs before those of
    outputs.
    """
    rows: list[Row] = []
    for at in range(0, len(names), MAX_AT_ONCE):
        rows += (await client.call("image", tags=names[at : at + MAX_AT_ONCE]))["tags"]
    return sorted(rows, key=lambda row: _SIDES.index(row["side"]))  # names of the same side keep their order


async def ask_tags(client: ControlClient, patterns: tuple[str, ...]) -> list[Row]:
    return await ask_rows(client, await chosen_tags(client, patterns))


def tags_as_data(rows: list[Row]) -> dict[str, Row]:
    """Return tags as JSON data, by name.

    An output that is read back from its device is also an input: its entry has the commanded value, and the value read as
    `input`.
    """
    found: dict[str, Row] = {}
    for row in rows:
        before = found.get(row["tag"])
        found[row["tag"]] = row if before is None else {**row, "input": before}
    return found


def tag_table(rows: list[Row]) -> Table:
    table = Table(box=None, pad_edge=False)
    names = ["tag", "value", "unit", "limits", "quality", "age", ""]
    if _width() < ROOM_FOR_LIMITS or not any(_limits(row["limits"]) for row in rows):
        names.remove("limits")
    for name in names:
        justify: Any = "right" if name in ("value", "age") else "left"
        table.add_column(name, justify=justify, no_wrap=name not in ("quality", "limits"))
    for row in rows:
        forced = row["forced"]
        is_time = row["unit"] == "ns" and row["value"] is not None
        style = "yellow" if forced else "red" if row["quality"] == "bad" else ""
        cells = {
            "tag": row["tag"],
            "value": _named(row, row["value"] / NS_PER_S if is_time else row["value"]),
            "unit": "s" if is_time else row["unit"],
            "limits": _limits(row["limits"]),
            "quality": _quality(row),
            "age": "-" if row["age_s"] is None else _age(row["age_s"] * 1000),
            "": f"FORCED {row['side']}" if forced else row["kind"] if row["side"] == "internal" else row["side"],
        }
        table.add_row(*(Text(cells[name]) for name in names), style=style)
    return table


def _named(row: Row, value: Any) -> str:
    """Return the name of a state, otherwise the value as text, with the name that the device's profile gives to it."""
    number = str(int(value)) if isinstance(value, int) else ""
    word = row["words"].get(number)
    return str(word) if word is not None else value_text(value, row["value_names"].get(number, ""))


def _limits(limits: list[float] | None) -> str:
    """Return the limits as text; an empty string if they only state the range of an integer type."""
    if limits is None or tuple(limits) in _WHOLE_TYPES:
        return ""
    return f"{limits[0]:.6g}..{limits[1]:.6g}"


def _quality(row: Row) -> str:
    """Return the quality with its reason, and the substitute value that programs see."""
    text = str(row["quality"] or "") + ("" if row["reason"] == "none" else f": {row['reason']}")
    for variable, seen in row["seen"].items():
        text += f"; {variable} sees {value_text(seen['value'])} ({seen['quality']})"
    return text


def print_tags(rows: list[Row]) -> None:
    print_table(tag_table(rows))


def _width() -> int:
    """Return the number of columns: the terminal's; for a pipe a number that is large enough for all lines."""
    return stdout.width if stdout.is_terminal else IN_A_PIPE


def print_table(table: Table) -> None:
    console = stdout if stdout.is_terminal else Console(file=stdout.file, width=IN_A_PIPE, highlight=False, emoji=False)
    console.print(table)


async def watch_live(path: Path, patterns: tuple[str, ...]) -> None:
    client = await ControlClient.connect_unix(path)
    try:
        with Live(console=stdout, auto_refresh=False, transient=True) as live:
            async for rows in live_rows(client, patterns):
                live.update(tag_table(rows), refresh=True)
                await asyncio.sleep(REFRESH_S)
    finally:
        await client.aclose()


async def live_rows(client: ControlClient, patterns: tuple[str, ...]) -> AsyncIterator[list[Row]]:
    """Yield the rows of the tags that match, without end, with the variables that online changes add and remove."""
    names: list[str] = []
    for n in count():
        if n % NAMES_EVERY == 0:
            names = await chosen_tags(client, patterns)
        try:
            rows = await ask_rows(client, names)
        except RemoteError:  # a variable was removed since the names were read
            names = await chosen_tags(client, patterns)
            rows = await ask_rows(client, names)
        yield rows


def print_status(status: PlcStatus) -> None:
    head = status.state
    if status.stop_reason != "none":
        head += f" ({status.stop_reason})"
    if status.restart_in_ms is not None:
        head += f", restarts in {status.restart_in_ms / 1000:.1f} s"
    stdout.print(f"PLC: {head}", markup=False)
    if status.error:
        stdout.print(f"  {status.error}", markup=False, soft_wrap=True)
    if status.debugger:
        stdout.print(f"  DEBUGGER: {status.debugger}", style="yellow", markup=False, soft_wrap=True)
    for text in [*waiting_texts(status.waiting), *without_texts(status.started_without)]:
        stdout.print(f"  {text}", style="yellow", markup=False, soft_wrap=True)
    stdout.print(f"gateway: {'alive' if status.gateway_alive else 'DEAD: every input is bad'}", markup=False)
    table = Table(box=None, pad_edge=False)
    for name in (
        "task",
        "every",
        "scans",
        "missed",
        "overrun",
        "late\np50",
        "\np99",
        "\nmax",
        "takes\np50",
        "\np99",
        "\nmax",
    ):
        is_text = name in ("task", "every")
        table.add_column(name, justify="left" if is_text else "right", no_wrap=not is_text, overflow="fold")
    for name, task in status.tasks.items():
        late, took = task.lateness_us, task.duration_us
        every = f"on {task.single}" if task.single else f"{task.cycle_ms:g} ms"
        table.add_row(
            name, every, str(task.scans), str(task.missed_periods), str(task.overruns),
            *(_us(late[k]) for k in ("p50", "p99", "max")), *(_us(took[k]) for k in ("p50", "p99", "max")),
        )  # fmt: skip
    print_table(table)
    replaced = f"; programs replaced while they ran: {status.changes.count}" if status.changes.count else ""
    stdout.print(f"restarts: {status.restarts}; {status.retain.start}{replaced}", markup=False)
    realtime = status.realtime or RealtimeStatus()
    stdout.print("granted: " + (", ".join(realtime.granted) or "nothing"), markup=False, soft_wrap=True)
    if realtime.refused:
        stdout.print(
            "refused: " + ", ".join(f"{k} ({v})" for k, v in realtime.refused.items()), markup=False, soft_wrap=True
        )
    counters = {name: count for name, count in status.counters.items() if count}
    if counters:
        stdout.print("counted: " + ", ".join(f"{n} {c}" for n, c in counters.items()), markup=False)
    if status.acts:
        stdout.print("done to it: " + acts_text(status.acts), markup=False)
    if status.forces:
        stdout.print(f"FORCED: {len(status.forces)}", style="yellow")
        for tag, force in status.forces.items():
            by = f" by {force['by']}" if force["by"] else ""
            stdout.print(f"  {tag} = {force['value']}{by}, {_age(force['age_ms'])} ago", style="yellow", markup=False)
    else:
        stdout.print("no tag is forced")


def waiting_texts(waiting: Mapping[str, WaitingStatus]) -> list[str]:
    """Return one line for each program that has not started: its missing inputs, the time waited, the timeout's effect."""
    return [
        f"WAITING: program {program} starts after its inputs have been good once; missing {start.reason}; "
        f"{start.since_s:.0f} s so far, {AT_TIMEOUT[start.at_timeout].format(start.timeout_s)}"
        for program, start in waiting.items()
    ]


def without_texts(started_without: Mapping[str, Mapping[str, str]]) -> list[str]:
    """Return one line for each program that started although inputs were missing."""
    return [
        f"program {program} started without " + ", ".join(f"{tag} ({reason})" for tag, reason in missing.items())
        for program, missing in started_without.items()
    ]


def is_now(rows: list[Row], tag: str) -> str:
    """Return the present value of a tag that is about to be forced, as text with unit and limits. For an output that is
    read back from its device this is the commanded value.
    """
    if not rows:
        raise UsageError(f"no tag {tag!r}", expected="a tag without *")
    row = rows[-1]
    about = [row["side"], _quality(row), *([_limits(row["limits"])] if _limits(row["limits"]) else [])]
    return f"{_named(row, row['value'])} {row['unit']}".strip() + f" ({', '.join(about)})"


def acts_text(acts: dict[str, int]) -> str:
    """Return users' actions on the PLC, and how often: ``2 x force, 1 x pause``."""
    return ", ".join(f"{count} x {what}" for what, count in acts.items())


def print_why(tag: str, changes: list[dict[str, Any]], waits_for: str = "") -> None:
    """Print which program last changed a tag, and from which inputs.

    `waits_for`: the inputs for which the program that writes the tag waits before it starts.
    """
    if waits_for:
        stdout.print(f"{tag}: its program has not started; missing {waits_for}", markup=False, soft_wrap=True)
    elif not changes:
        stdout.print(f"{tag} has not changed since the programs began", markup=False)
    for change in changes:
        by = "a force, through" if change["forced"] else ""
        stdout.print(
            f"{_age(change['age_ms'])} ago, scan {change['scan']}: "
            f"{value_text(change['before'])} to {value_text(change['after'])}, "
            f"by {by + ' ' if by else ''}program {change['program']}",
            markup=False,
        )
        if change["place"]:
            _print_decision(change["place"], change["decided"] or {})
        for name, value in change["inputs"].items():
            stdout.print(f"    {name} was {value_text(value)}", markup=False)


def _print_decision(place: str, decided: Mapping[str, Any]) -> None:
    """Print the line that made a change; for Structured Text with its statement, the conditions around it, and the values that
    its variables had after the scan. The statements that assigned what it used follow.
    """
    _print_statement(f"in {place}", decided)
    for one in decided.get("inside", ()):
        block = f" ({one['block']})" if one["block"] else ""
        scan = f", scan {one['scan']}" if one.get("scan") else ""
        _print_statement(f"{one['instance']}{block}: in {one['place']}{scan}", one)


def _print_statement(where: str, decided: Mapping[str, Any]) -> None:
    stdout.print(f"    {where}  {decided.get('statement', '')}".rstrip(), markup=False, soft_wrap=True)
    if decided.get("executed_in"):
        stdout.print(f"        executed in {decided['executed_in']}", markup=False, soft_wrap=True)
    for one in decided.get("conditions", ()):
        said = "because" if one["holds"] else "because not"
        stdout.print(f"        {said} {one['text']}  (line {one['line']})", markup=False, soft_wrap=True)
    for name, value in decided.get("variables", {}).items():
        stdout.print(f"        {name} is {value} after the scan", markup=False, soft_wrap=True)
    for name, value in decided.get("indices", {}).items():
        stdout.print(f"        {name} was {value} in this line", markup=False, soft_wrap=True)
    for name, path in decided.get("pointed", {}).items():
        stdout.print(f"        {name} pointed to {path} in this line", markup=False, soft_wrap=True)
    for note in decided.get("notes", ()):
        stdout.print(f"        not followed: {note}", markup=False, soft_wrap=True)


def _us(us: float) -> str:
    return f"{us:.0f}us" if us < 10_000 else f"{us / 1000:.1f}ms"


def _age(ms: float) -> str:
    return f"{ms:.0f} ms" if ms < 10_000 else f"{ms / 1000:.0f} s" if ms < 600_000 else f"{ms / 60_000:.0f} min"


def value_text(value: Any, name: str = "") -> str:
    """Return a value as text: floats with six digits, a missing value as a dash, and its name, if it has one, in brackets."""
    if value is None:
        return "-"
    text = f"{value:.6g}" if isinstance(value, float) else str(value)
    return f"{text} ({name})" if name else text
