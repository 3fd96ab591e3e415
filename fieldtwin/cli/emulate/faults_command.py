"""`fieldtwin faults`: list the faults, where they apply, and their parameters."""

from __future__ import annotations

import json
import sys
from typing import Any

import click
from rich.table import Table

from fieldtwin.cli.options import json_option
from fieldtwin.console import stdout


@click.command("faults")
@click.argument("names", nargs=-1)
@json_option
def command(names: tuple[str, ...], as_json: bool) -> int:
    """List the faults, or describe the faults NAMES in full. For `exception` and `sdo-abort` this includes the codes of the
    standards.

    A fault file is `faults: [{name: silence, device: ctd, from: 5s, until: 12s}]`, for `fieldtwin run --prototype --faults
    FILE`, `fieldtwin emulate DEVICE --faults FILE` and `fieldtwin link --faults FILE`. Every fault has these optional keys:
    id, bus or device, unit, function, address or register, registers, cob_id, direction (request, reply, both), nth, every,
    from, until, probability.
    """
    from fieldtwin.emulators.faults.description import describe_fault
    from fieldtwin.emulators.faults.registry import FAULTS, fault_class

    chosen = [fault_class(name) for name in names] or list(FAULTS.values())
    described = [describe_fault(kind) for kind in chosen]
    if as_json:
        json.dump(described, sys.stdout, indent=2)
        sys.stdout.write("\n")
        return 0
    for on in dict.fromkeys(d["on"] for d in described):
        table = Table(title=on, title_justify="left", title_style="bold", box=None, show_header=False, pad_edge=False)
        table.add_column(no_wrap=True)
        table.add_column()
        for d in described:
            if d["on"] == on:
                table.add_row(d["name"], _told(d, codes=bool(names)))
        stdout.print(table)
        stdout.print()
    return 0


def _told(described: dict[str, Any], *, codes: bool) -> str:
    own = ", ".join(f"{name}: {_number(p['default'])}" for name, p in described["parameters"].items())
    known = "".join(f"\n{code}  {text}" for code, text in described.get("codes", {}).items()) if codes else ""
    return f"{described['summary']}" + (f" [dim]({own})[/dim]" if own else "") + known


def _number(value: float | str | None) -> str:
    """Return a number as text; codes, which are large, in hexadecimal."""
    if value is None:
        return "by the tag's type"
    if isinstance(value, str | bool):
        return json.dumps(value)
    return f"0x{value:X}" if isinstance(value, int) and value >= 0x1000 else f"{value:g}"
