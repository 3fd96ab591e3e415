"""The league's results, as docs/reference/league.json holds them, and the page with the published table."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
RESULTS, LOCK = ROOT / "docs/reference/league.json", ROOT / "scripts/league.toml"
KINDS = {
    "modbus-clients": "Modbus clients",
    "modbus-devices": "Modbus servers",
    "canopen-clients": "CANopen SDO clients",
    "canopen-devices": "CANopen nodes",
}
COLUMNS = (
    *("stack", "version", "from", "wire", "interface", "passed"),
    *("fails what the standard requires", "fails robustness and field cases"),
)
WIRES = {"tcp": "TCP", "rtu": "RTU", "ascii": "ASCII", "can": "CAN"}


@dataclass(frozen=True)
class Failure:
    """A failed case of a stack: what fieldtwin found, and what the program without fieldtwin observed."""

    id: str
    basis: str
    reason: str
    frames: Sequence[str]
    confirmed: bool
    sent: str = ""
    observed: str = ""


@dataclass(frozen=True)
class Row:
    """An entry of the league."""

    kind: str
    name: str
    stack: str
    version: str
    origin: str
    wire: str
    api: str
    date: str
    passed: Sequence[str]
    skipped: Sequence[str]
    inconclusive: dict[str, str]
    failed: Sequence[Failure]

    @property
    def title(self) -> str:
        return f"{self.stack} {self.version}, {WIRES[self.wire]}, `{self.api}`"


def rows() -> list[Row]:
    """Return the entries in the order of the lock file."""
    return [_row(entry) for entry in json.loads(RESULTS.read_text("utf-8"))["entries"]]


def _row(entry: dict[str, Any]) -> Row:
    failed = [Failure(id=id, **found) for id, found in entry["failed"].items()]
    return Row(
        **{key: value for key, value in entry.items() if key != "from"} | {"origin": entry["from"], "failed": failed}
    )


def league_page() -> str:
    """Return the page as Markdown."""
    held = json.loads(RESULTS.read_text("utf-8"))
    lock = tomllib.loads(LOCK.read_text("utf-8"))
    return "\n".join([*_introduction(rows()), *_tables(rows()), *_dead_units(held), *_missing(lock)])


def _introduction(found: Sequence[Row]) -> Iterator[str]:
    failures = [f for row in found for f in row.failed]
    confirmed = sum(f.confirmed for f in failures)
    yield f"""# The league: test results of third-party stacks

`scripts/league` installs each stack in the exact version of `scripts/league.toml` and runs `fieldtwin check`
against it, on loopback, ptys and a software CAN bus. Each failure is then repeated by a program of
`scripts/league_confirm` that does not use fieldtwin: it sends the bytes itself and observes what the stack does. A
failure that this program does not observe is listed as *unconfirmed* and is no verdict about the stack. Of
{len(failures)} failures in {len(found)} rows, {confirmed} are confirmed.

A case links to its page, which has the bytes, the clause and the frames of each failure.

- A client reads two registers (one object) 20 ms after the last answer, with a timeout of 150 ms and without
  retries. pymodbus 3.0 takes whole seconds: 1 s.
- A server has 200 holding registers and 48 coils; everything is allowed (`--allow disrupt`). A failed case is
  repeated with a fresh process, and the repetition counts.
- The program around a library also takes part: it reconnects after errors, above all in MB-064 to MB-066. The
  programs are in `scripts/league_programs`.
- Failures of cases that no standard requires are in a column of their own: such a stack conforms, but is less
  tolerant than it could be.
- INCONCLUSIVE with every client: MB-025, because the programs merge no reads.

Repeat a row with `scripts/league --only NAME`; `scripts/league --list` shows the names.
"""


def _tables(found: Sequence[Row]) -> Iterator[str]:
    for kind, title in KINDS.items():
        yield f"## {title}\n"
        yield f"| {' | '.join(COLUMNS)} |"
        yield f"|{'---|' * len(COLUMNS)}"
        for row in found:
            if row.kind == kind:
                required = [f for f in row.failed if f.basis == "standard"]
                others = [f for f in row.failed if f.basis != "standard"]
                yield (
                    f"| {row.stack} | {row.version} | {row.origin} | {WIRES[row.wire]} | `{row.api}` | {len(row.passed)} "
                    f"| {_cases(required)} | {_cases(others)} |"
                )
        yield ""


def _cases(failures: Sequence[Failure]) -> str:
    sure = ", ".join(link(f.id) for f in failures if f.confirmed)
    open_ = ", ".join(link(f.id) for f in failures if not f.confirmed)
    return "; ".join(filter(None, (sure, f"*unconfirmed:* {open_}" if open_ else ""))) or "nothing"


def link(id: str, folder: str = "cases/") -> str:
    """Return a link to the page of a case."""
    return f"[{id}]({folder}{id.rstrip('abcdefgh').lower()}.md#{id.lower()})"


def _dead_units(held: dict[str, Any]) -> Iterator[str]:
    if "dead_units" in held:
        yield "## One live unit among 30 dead ones\n"
        yield (
            "A serial line at 19200 8N1 with 31 units, of which one answers. Each is to be polled every 500 ms, with a timeout"
            " of 1 s and one repetition. The share of the live unit's polls that took place (`benchmarks/dead_units.py`):\n"
        )
        yield "| poller | version | worst minute | whole time |\n|---|---|---|---|"
        for poller in held["dead_units"]:
            yield f"| {poller['name']} | {poller['version']} | {poller['worst_minute']:.1%} | {poller['whole']:.1%} |"
        yield ""


def _missing(lock: dict[str, Any]) -> Iterator[str]:
    yield "## Not in the tables\n"
    yield "| stack | reason |\n|---|---|"
    for name, reason in lock["missing"].items():
        yield f"| {name} | {reason} |"
    yield ""
