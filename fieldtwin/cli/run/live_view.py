"""A run on the terminal: a live table (elsewhere one line a second), and the summary at the end.

Everything comes from the session's statuses; this module only formats text.
"""

from __future__ import annotations

import asyncio
from itertools import islice
from types import TracebackType
from typing import Any

import msgspec
from rich.console import Group, RenderableType
from rich.live import Live
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from fieldtwin.cli.run.plc_views import acts_text, waiting_texts, without_texts
from fieldtwin.console import stderr, stdout
from fieldtwin.gateway.runtime.gateway_status import BusStatus, FrontStatus, GatewayStatus
from fieldtwin.plc.status import PlcStatus
from fieldtwin.results.trace import refusal_text
from fieldtwin.run.live.session import RunSession
from fieldtwin.twin.prototype.field_status import StruckStatus

COLOUR = {"good": "green", "uncertain": "yellow", "bad": "red", "substituted": "magenta", "simulated": "cyan"}
REFRESH_S = 0.25
LINE_S = 1.0
MAX_TAGS = 40
MAX_TROUBLES = 5
MAX_FORCES = 6
MAX_REFUSED = 5
READ_ONLY = "read-only"
"""The cause of a refusal that is intended: the plant runs read-only."""
MOST_FAULTS = 20


def print_mapping(session: RunSession) -> None:
    """Print once which endpoint stands in for each plant endpoint."""
    if not session.options.prototype:
        leave = "writes allowed" if session.options.allow_writes else "read-only"
        stderr.print(f"[bold]plant[/bold] {session.system.name}: {leave}; instance {session.instance.name}")
        _print_thread(session)
        return
    stderr.print(
        f"[bold]prototype[/bold] of {session.system.name}; instance {session.instance.name} in {session.instance.dir}",
        soft_wrap=True,
    )
    for plant, target in session.mapping.items():
        stderr.print(
            f"  {plant}  →  {target}" if plant != target else f"  {plant}  (the plant's endpoint)", soft_wrap=True
        )
    for bridge, cable in session.cables.items():
        stderr.print(f"  clients of bridge {bridge}  →  {cable.master}", soft_wrap=True)
    for device, endpoint in session.far.items():
        stderr.print(f"  topside end of {device}  →  {endpoint}", soft_wrap=True)
    _print_thread(session)


def print_studio(url: str) -> None:
    """Print once the address of the page."""
    stderr.print(f"  studio  →  {url}", soft_wrap=True, markup=False, highlight=False)


def print_metrics(url: str) -> None:
    """Print once the address of the metrics."""
    if url:
        stderr.print(f"  metrics  ←  {url}", soft_wrap=True)


def _print_thread(session: RunSession) -> None:
    if session.thread_place:
        stderr.print(f"  digital thread  ←  {session.thread_place}", soft_wrap=True)


class LiveView:
    """``async with LiveView(session)``: show the run while the body runs, on a terminal as a table, else as lines."""

    def __init__(self, session: RunSession, quiet: bool) -> None:
        self._session = session
        self._task: asyncio.Task[None] | None = None
        self._table = stderr.is_terminal and not quiet
        self._quiet = quiet

    async def __aenter__(self) -> LiveView:
        if not self._quiet:
            self._task = asyncio.get_running_loop().create_task(
                self._show_table() if self._table else self._show_lines()
            )
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None
    ) -> None:
        if self._task is not None:
            self._task.cancel()
            try:
                await self._task
            except asyncio.CancelledError:
                pass  # requested by the options

    async def _show_table(self) -> None:
        open_ports: set[str] = set()
        with Live(render(self._session), console=stderr, auto_refresh=False, transient=True) as live:
            while True:
                open_ports = self._tell_once(open_ports)
                live.update(render(self._session), refresh=True)
                await asyncio.sleep(REFRESH_S)

    async def _show_lines(self) -> None:
        told: set[str] = set()
        open_ports: set[str] = set()
        while True:
            await asyncio.sleep(LINE_S)
            open_ports = self._tell_once(open_ports)
            now = [*troubles(self._session), *_waiting_once(self._session)]
            for trouble in now:
                if trouble not in told:  # a problem is printed once, and again only after it had disappeared
                    stderr.print(f"! {trouble}", soft_wrap=True, markup=False)
            told = set(now)
            stderr.print(line(self._session), soft_wrap=True, markup=False)

    def _tell_once(self, told: set[str]) -> set[str]:
        """Print once where the gateway listens (a prototype takes free ports), and report recovered simulated devices."""
        now = set(ports(self._session))
        if (back := self._session.field_return) is not None and back.news:
            now.add(back.news)
        for text in sorted(now - told):
            stderr.print(f"  {text}", soft_wrap=True, markup=False)
        return now


def ports(session: RunSession) -> list[str]:
    """Return where the gateway serves tags and lets clients reach units."""
    return [f"{kind} {name}  ←  {front.listening}" for kind, name, front in _fronts(session) if front.listening]


def _fronts(session: RunSession) -> list[tuple[str, str, FrontStatus]]:
    """Return kind, name and status of each server and bridge."""
    gateway = session.gateway_status
    if gateway is None:
        return []
    return [
        (kind, name, front)
        for kind, fronts in (("serve", gateway.serve), ("bridge", gateway.bridge))
        for name, front in fronts.items()
    ]


def troubles(session: RunSession) -> list[str]:
    """Return the present problems with their reasons.

    They are errors of the run, buses that cannot be opened, devices that do not answer, and what stopped the PLC, the digital
    thread's carrier or its store.
    """
    gateway = session.gateway_status
    found = list(session.errors)
    if session.field_return is not None and (trouble := session.field_return.trouble):
        found.append(trouble)
    closed = {name: bus.error for name, bus in (gateway.buses if gateway else {}).items() if bus.error}
    found += [f"{name}: {error}" for name, error in closed.items()]
    found += [f"{kind} {name}: {front.error}" for kind, name, front in _fronts(session) if front.error]
    for name, device in (gateway.devices if gateway else {}).items():
        if device.error and device.error != closed.get(device.bus):
            found.append(f"{name}: {device.error}")
        if device.unstarted:
            found.append(f"{name}: {device.unstarted}")
    if session.plc_status is not None and session.plc_status.error:
        found.append(f"PLC: {session.plc_status.error}")
    if gateway is not None:
        found += refused(gateway)
    if (thread := session.thread_status) is not None:
        found += [f"thread: {thread.trouble}"] if thread.trouble else []
        found += [f"store of the thread: {thread.store_trouble}"] if thread.store_trouble else []
    return found


def refused(gateway: GatewayStatus) -> list[str]:
    """Return the refused outputs, each with its value, the reason and the program's line.

    In a read-only plant one line stands for all outputs that are not written by design.
    """
    entries = [e for e in gateway.refusals.entries if e.standing]
    by_design = {e.tag for e in entries if e.cause == READ_ONLY}
    found = [refusal_text(e.tag, msgspec.structs.asdict(e)) for e in entries if e.cause != READ_ONLY]
    if by_design:
        found.append(f"read-only plant: {', '.join(sorted(by_design))} not written (--allow-writes)")
    return found


def interference(session: RunSession) -> list[str]:
    """Return why the PLC does not follow its programs: it is paused, a program waits for its start, or a tag is forced."""
    plc = session.plc_status
    if plc is None:
        return []
    found = ["PAUSED: the PLC executes no program, its outputs keep their values"] if plc.state == "paused" else []
    found += waiting_texts(plc.waiting)
    if plc.forces:
        found.append(f"FORCED: {forces_text(plc.forces)}")
    return found


def _waiting_once(session: RunSession) -> list[str]:
    """Return the waiting programs without the seconds, so that a log reports each once."""
    waiting = session.plc_status.waiting if session.plc_status is not None else {}
    return [f"program {program} has not started; missing {start.reason}" for program, start in waiting.items()]


def forces_text(forces: dict[str, Any]) -> str:
    """Return ``ctd.pressure = 5 by ada, ...``: the first few forces and the number of the rest."""
    shown = [
        f"{tag} = {value_text(force['value'])}" + (f" by {force['by']}" if force["by"] else "")
        for tag, force in list(forces.items())[:MAX_FORCES]
    ]
    more = len(forces) - len(shown)
    return ", ".join(shown) + (f" and {more} more" if more else "")


def line(session: RunSession) -> str:
    """Return the state of the run as one line."""
    gateway, plc = session.gateway_status, session.plc_status
    parts = [f"t={session.elapsed_s:.0f}s"]
    parts += [f"{program}={state}" for program, state in session.states.current.items()]
    if gateway is not None:
        parts += [f"{name}={'good' if device.online else 'bad'}" for name, device in gateway.devices.items()]
    tags = gateway.tags if gateway is not None else {}
    parts.append(f"tags_good={sum(t.quality == 'good' for t in tags.values())}/{len(tags)}")
    parts.append(f"requests={sum(map(_requests, gateway.buses.values())) if gateway is not None else 0}")
    if plc is not None and session.system.plc.programs:
        parts.append(f"scans={plc.scans} late_p99_us={_p99(plc)}")
    parts.append(f"errors={len(session.errors)}")
    if plc is not None and plc.state == "paused":
        parts.append("PLC PAUSED")
    if plc is not None and plc.waiting:
        parts.append(f"PLC WAITING={','.join(plc.waiting)}")
    if plc is not None and plc.forces:
        parts.append(f"FORCED={','.join(plc.forces)}")
    if gateway is not None and not gateway.plc.alive:
        parts.append("PLC LOST")
    return " ".join(parts)


def _requests(bus: BusStatus) -> int:
    return bus.counters.get("requests", 0) or bus.counters.get("sdo_requests", 0)


def _p99(plc: PlcStatus) -> str:
    value = plc.lateness_us.get("p99")
    return "-" if value is None else f"{value:.0f}"


def render(session: RunSession) -> RenderableType:
    """Return the live table in the terminal's width."""
    kind = "prototype" if session.options.prototype else "plant"
    left = session.options.duration_s
    clock = f"{session.elapsed_s:5.1f} s" + (f" of {left:.0f} s" if left else "")
    head = Text.assemble((f" {session.system.name} ", "bold reverse"), f" {kind}  {clock}  ", _states(session))
    parts: list[RenderableType] = [head, _devices(session), _foot(session)]
    parts += [Text(text, style="bold yellow") for text in interference(session)]
    parts += [Text(f"! {trouble}", style="red") for trouble in troubles(session)[-MAX_TROUBLES:]]
    parts.append(_tags(session))  # this table comes last, so that a low terminal cuts off only the end of the list
    return Group(*parts)


def _states(session: RunSession) -> Text:
    text = Text()
    for program, state in session.states.current.items():
        text.append(f"{program} ", "dim")
        text.append(state, "bold green" if state == "ACTIVE" else "bold")
    return text


def _devices(session: RunSession) -> Table:
    table = Table(expand=False, pad_edge=False, box=None, header_style="dim")
    for column, justify in (
        ("device", "left"),
        ("state", "left"),
        ("bus", "left"),
        ("requests", "right"),
        ("replies", "right"),
        ("errors", "right"),
    ):
        table.add_column(column, justify=justify, no_wrap=True)  # type: ignore[arg-type]
    gateway = session.gateway_status
    for name, device in (gateway.devices if gateway is not None else {}).items():
        counters = gateway.buses[device.bus].counters if gateway is not None else {}
        good = device.online
        table.add_row(
            name,
            # the reason is shown below the table, where there is more room
            Text("good", "green") if good else Text("bad", "red"),
            f"{device.bus}:{device.address}",
            str(counters.get("requests", counters.get("sdo_requests", 0))),
            str(counters.get("replies", counters.get("sdo_replies", 0))),
            str(device.errors),
        )
    return table


def _tags(session: RunSession) -> Table:
    table = Table(expand=False, pad_edge=False, box=None, header_style="dim")
    table.add_column("tag", no_wrap=True)
    table.add_column("value", justify="right", no_wrap=True)
    table.add_column("unit", no_wrap=True)
    table.add_column("quality", no_wrap=True)
    table.add_column("age", justify="right", no_wrap=True)
    secrets = {
        f"{d.name}.{t.name}" for d in session.system.devices.values() for t in d.profile.tags.values() if t.secret
    }
    units = {f"{d.name}.{t.name}": t.unit for d in session.system.devices.values() for t in d.profile.tags.values()}
    tags = session.gateway_status.tags if session.gateway_status is not None else {}
    for name, tag in islice(tags.items(), MAX_TAGS):
        quality = tag.quality + (f" ({tag.reason})" if tag.reason != "none" else "")
        table.add_row(
            name,
            "(secret)" if name in secrets else value_text(tag.value),
            units.get(name, ""),
            Text(quality, COLOUR.get(tag.quality, "")),
            age_text(tag.age_s),
        )
    return table


def value_text(value: Any) -> str:
    """Return a value as text: floats with six digits, a missing value as a dash."""
    if value is None:
        return "-"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def age_text(age_s: float | None) -> str:
    return "-" if age_s is None else f"{age_s:.2f} s" if age_s < 100 else f"{age_s:.0f} s"


def _foot(session: RunSession) -> Text:
    gateway, plc = session.gateway_status, session.plc_status
    text = Text()
    if plc is not None and session.system.plc.programs:
        late = plc.lateness_us
        lateness = " ".join(f"{key} {_us(late, key)}" for key in ("p50", "p99", "max"))
        text.append("scan ", "dim")
        text.append(f"{plc.cycle_ms:g} ms  #{plc.scans}  late {lateness}")
        text.append(f"  missed {plc.missed_periods}  {plc.state}")
    elif plc is None and session.children.get("plc"):
        text.append("PLC: no answer", "bold red")
    for name, box in (gateway.mailboxes if gateway is not None else {}).items():
        text.append(f"\n{name} ", "dim")
        text.append(f"received {box.received}  sent {box.sent}  taken {box.taken}  waiting {box.queued}")
    text.append("\nlogged ", "dim")
    text.append(f"{gateway.logged if gateway is not None else 0}")
    if session.options.prototype:
        oracle = session.oracle.describe()
        text.append(f"   published values checked {oracle['checked']}, wrong {oracle['wrong']}")
    return text


def _us(late: dict[str, Any], key: str) -> str:
    value = late.get(key)
    return "-" if value is None else f"{value / 1000:.2f} ms"


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
    for text in without_texts(summary["plc"].get("started_without", {})):
        stdout.print(f"  [yellow]start[/yellow]          {text}", soft_wrap=True, highlight=False)
    if acts := summary["plc"].get("acts"):
        left = summary["plc"].get("forces")
        stdout.print(f"  [yellow]manual[/yellow]         actions on the PLC: {acts_text(acts)}", soft_wrap=True)
        if left:
            stdout.print(f"  [yellow]FORCED[/yellow]         at the end: {forces_text(left)}", soft_wrap=True)
    _print_refused(summary)
    for one in summary["invariants"]:
        if one["verdict"] != "failed":  # the failed ones are among the errors
            said = "holds" if one["verdict"] == "passed" else "not checked"
            text = f"  {one['number']}: {one['text']}: {said}, {one['got']}"
            stdout.print(text, soft_wrap=True, markup=False, highlight=False)
    told = {f"{name}: {device['error']}" for name, device in summary["devices"].items() if device["state"] != "good"}
    for error in summary["errors"]:
        if error in told:  # listed with the device, above
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
    others = [e for e in summary["refused"] if e["cause"] != READ_ONLY and not e["fault"]]
    for entry in others[:MAX_REFUSED]:
        text = refusal_text(entry["tag"], entry)
        stdout.print(f"  not written    {text}", soft_wrap=True, markup=False, highlight=False)
    if len(others) > MAX_REFUSED:
        stdout.print(f"  not written    {len(others) - MAX_REFUSED} more, see the audit log", soft_wrap=True)


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
    """Return the gaps that were learnt about a device. The last line is ready to be copied into its profile."""
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
