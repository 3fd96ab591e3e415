"""The summary of a run, as text on stdout."""

from __future__ import annotations

from typing import Any

import msgspec
from rich.markup import escape

from fieldtwin.cli.plc.views import acts_text, without_texts
from fieldtwin.cli.run.alarms_view import standing
from fieldtwin.cli.run.troubles import READ_ONLY, forces_text
from fieldtwin.console import stdout
from fieldtwin.gateway.runtime.gateway_status import AlarmStatus
from fieldtwin.results.trace import refusal_text
from fieldtwin.twin.prototype.field_status import StruckStatus

MAX_REFUSED = 5
MOST_FAULTS = 20


def print_summary(summary: dict[str, Any]) -> None:
    """Print the summary of a run on stdout."""
    kind = "prototype" if summary["prototype"] else "plant"
    stdout.print(f"[bold]{summary['system']}[/bold] ({kind}), {summary['duration_s']:.1f} s")
    for name, device in summary["devices"].items():
        mark = "[green]good[/green]" if device["state"] == "good" else f"[red]bad[/red] {device['error']}"
        plays = f", from {device['plays']}" if "plays" in device else ""
        note = f", but {device['note']}" if device.get("note") else ""
        stdout.print(f"  {name:<14} {mark}{plays}{note}", soft_wrap=True, highlight=False)
    for program, states in summary["states"].items():
        stdout.print(f"  {program:<14} {' → '.join(states) or 'no scan observed'}")
    for bus, row in summary["exchanges"].items():
        stdout.print(f"  {bus:<14} {_exchange_text(row)}", soft_wrap=True)
    print_faults(summary["faults"])
    published = summary["published"]
    if summary["prototype"]:
        checked = f"{published['checked']} compared with what the devices held, {published['wrong']} wrong"
        if published.get("unknown"):
            checked += f"; {published['unknown']} not verifiable, because the field simulator was lost"
        stdout.print(f"  published      {checked}", soft_wrap=True)
    else:
        values = "not known" if published["values"] is None else f"{published['values']} good values"
        stdout.print(f"  published      {values}")
    if (field := summary["field"]) and field["losses"]:
        stdout.print(
            f"  simulator      lost {_times(field['losses'])}, away for {field['away_s']:.1f} s", soft_wrap=True
        )
    if far := summary["topside"]:
        stdout.print(f"  topside        commands {far['commands_sent']}, responses {far['responses']}")
    stdout.print(f"  logged         {summary['logged']} exchanges")
    if thread := summary["thread"]:
        stdout.print(f"  thread         {_thread_text(thread)}", soft_wrap=True, markup=False, highlight=False)
    for name, learnt in summary["learnt"].items():
        stdout.print(f"  {name:<14} {_learnt_text(learnt, kind)}", soft_wrap=True, markup=False)
    for name, alarm in standing(msgspec.convert(summary.get("alarms", {}), dict[str, AlarmStatus])).items():
        text = f"{name}: {alarm.state.replace('_', ' ')}, {alarm.quality}{f': {alarm.text}' if alarm.text else ''}"
        stdout.print(f"  [yellow]alarm[/yellow]          {escape(text)}", soft_wrap=True, highlight=False)
    for text in without_texts(summary["plc"].get("started_without", {})):
        stdout.print(f"  [yellow]start[/yellow]          {text}", soft_wrap=True, highlight=False)
    if acts := summary["plc"].get("acts"):
        left = summary["plc"].get("forces")
        stdout.print(f"  [yellow]manual[/yellow]         actions on the PLC: {acts_text(acts)}", soft_wrap=True)
        if left:
            stdout.print(f"  [yellow]FORCED[/yellow]         at the end: {forces_text(left)}", soft_wrap=True)
    _print_refused(summary)
    for one in summary["invariants"]:
        if one["verdict"] != "failed":  # the failed checks are among the errors
            said = "holds" if one["verdict"] == "passed" else "not checked"
            text = f"  {one['number']}: {one['text']}: {said}, {one['got']}"
            stdout.print(text, soft_wrap=True, markup=False, highlight=False)
    told = {f"{name}: {device['error']}" for name, device in summary["devices"].items() if device["state"] != "good"}
    for error in summary["errors"]:
        if error in told:  # these problems are listed above, with the device
            continue
        stdout.print(f"  [red]error[/red]          {escape(error)}", soft_wrap=True)
    for what in summary["not_judged"]:
        stdout.print(f"  [yellow]not checked[/yellow]    {what}", soft_wrap=True, highlight=False)
    stdout.print("[bold green]ok[/bold green]" if summary["ok"] else "[bold red]not ok[/bold red]")


def _print_refused(summary: dict[str, Any]) -> None:
    """Print the writes that did not reach their device and are not errors: by design, retried, or requested by a client."""
    by_design = sorted({e["tag"] for e in summary["refused"] if e["cause"] == READ_ONLY})
    if by_design:
        text = f"{', '.join(by_design)}: not written, the plant is read-only (--allow-writes)"
        stdout.print(f"  not written    {text}", soft_wrap=True, markup=False, highlight=False)
    others = _newest([e for e in summary["refused"] if e["cause"] != READ_ONLY and not e["fault"]])
    for entry in others[:MAX_REFUSED]:
        text = refusal_text(entry["tag"], entry)
        stdout.print(f"  not written    {text}", soft_wrap=True, markup=False, highlight=False)
    if len(others) > MAX_REFUSED:
        stdout.print(f"  not written    {len(others) - MAX_REFUSED} more, see the audit log", soft_wrap=True)


def _newest(entries: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return one entry for each tag, cause and line of a program: the newest value, with the number of all values."""
    found: dict[tuple[object, ...], dict[str, Any]] = {}
    for entry in entries:
        key = (entry["tag"], entry["cause"], entry.get("by"), entry.get("place"))
        before = found.pop(key, {"count": 0})
        found[key] = {**entry, "first": entry.get("value"), "count": before["count"] + entry.get("count", 1)}
    return list(found.values())


def print_faults(faults: list[dict[str, Any]]) -> None:
    """Print how often each fault of a run took effect."""
    from fieldtwin.results.fault_counts import struck_of

    for fault in msgspec.convert(faults[:MOST_FAULTS], list[StruckStatus]):
        colour = "yellow" if not fault.struck and not fault.optional else "default"
        stdout.print(
            f"  [{colour}]fault[/{colour}]          {escape(struck_of(fault).text)}", soft_wrap=True, highlight=False
        )
    if len(faults) > MOST_FAULTS:
        idle = sum(not fault["struck"] for fault in faults)
        stdout.print(f"  faults         {len(faults)} in all, {idle} of them never took effect", soft_wrap=True)


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"


def _thread_text(thread: dict[str, Any]) -> str:
    """Return what the plant's side of the digital thread stored and sent, and the problems of its store or carrier."""
    text = f"{thread['written']} events kept, {thread['waiting']} not confirmed by the other side"
    troubles = [t for t in (thread["store_trouble"], thread["trouble"]) if t]
    return "; ".join([text, *troubles])


def _learnt_text(learnt: dict[str, Any], kind: str) -> str:
    """Return as text what was learnt about a device: missing addresses, and where it accepts fewer registers per read.

    The last part is ready to be copied into the device's profile.
    """
    parts = []
    if learnt["missing"]:
        parts.append(f"does not have {', '.join(learnt['missing'])}")
    if learnt["borders"]:
        parts.append(f"accepts fewer registers per read than `limits: read_registers`: {', '.join(learnt['borders'])}")
    if learnt["line"]:
        parts.append(f"for the profile of {learnt['profile']}: {learnt['line']}")
    return f"learnt from the {kind}: " + "; ".join(parts)


def _exchange_text(row: dict[str, Any]) -> str:
    gateway = row["gateway"]
    text = f"gateway {gateway['requests']} requests, {gateway['replies']} replies"
    if "pdos" in gateway:
        text += f", {gateway['pdos']} PDOs, {gateway['heartbeats']} heartbeats"
    if "emulators" in row:
        text += f"; emulators {row['emulators']['requests']} / {row['emulators']['replies']}"
        text += f", with those of {row['shared']}" if "shared" in row else ""
        text += f", and {row['others']['requests']} requests of other clients" if "others" in row else ""
    if row["timeouts"] or row["crc_errors"]:
        text += f"; {row['timeouts']} timeouts, {row['crc_errors']} CRC errors"
    return text
