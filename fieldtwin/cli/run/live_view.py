"""The display of a run on the terminal: a live table, or one line per second where stderr is not a terminal.

Everything comes from the session's statuses; this module only formats text.
"""

from __future__ import annotations

import asyncio
from itertools import islice
from types import TracebackType
from typing import Any

from msgspec import UNSET
from rich.console import Group, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from fieldtwin.cli.plc.views import value_text
from fieldtwin.cli.run.alarms_view import MOST_ALARMS, alarm_table, alarms_line, standing
from fieldtwin.cli.run.troubles import fronts_of, interference, troubles, waiting_once
from fieldtwin.console import stderr
from fieldtwin.gateway.runtime.gateway_status import BusStatus
from fieldtwin.plc.status import PlcStatus
from fieldtwin.run.live.session import RunSession

COLOUR = {"good": "green", "uncertain": "yellow", "bad": "red", "substituted": "magenta", "simulated": "cyan"}
REFRESH_S = 0.25
LINE_S = 1.0
MAX_TAGS = 40
MAX_TROUBLES = 5


def print_mapping(session: RunSession) -> None:
    """Print which endpoint replaces each endpoint of the plant; for a plant, whether writes are allowed."""
    if not session.options.prototype:
        leave = "writes allowed" if session.options.allow_writes else "read-only"
        stderr.print(f"[bold]plant[/bold] {session.system.name}: {leave}; instance {session.instance.name}")
        _print_thread(session)
        return
    stderr.print(
        f"[bold]prototype[/bold] of {session.system.name}; instance {session.instance.name} in {session.instance.dir}",
        soft_wrap=True,
    )
    read_only = {session.system.buses[name].endpoint for name in session.read_only}
    for plant, target in session.mapping.items():
        note = ", read-only without --allow-writes" if plant in read_only else ""
        stderr.print(
            f"  {plant}  →  {target}" if plant != target else f"  {plant}  (the plant's endpoint{note})", soft_wrap=True
        )
    for bridge, cable in session.cables.items():
        stderr.print(f"  clients of bridge {bridge}  →  {cable.master}", soft_wrap=True)
    for device, endpoint in session.far.items():
        stderr.print(f"  topside end of {device}  →  {endpoint}", soft_wrap=True)
    _print_thread(session)


def print_studio(url: str) -> None:
    """Print the address of the Studio page."""
    stderr.print(f"  studio  →  {url}", soft_wrap=True, markup=False, highlight=False)


def print_metrics(url: str) -> None:
    """Print the address of the metrics, if they are served."""
    if url:
        stderr.print(f"  metrics  ←  {url}", soft_wrap=True)


def _print_thread(session: RunSession) -> None:
    if session.thread_place:
        stderr.print(f"  digital thread  ←  {session.thread_place}", soft_wrap=True)


class LiveView:
    """The display of a run in progress: a table on a terminal, otherwise lines. It is updated during ``async with
    LiveView(session)``."""

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
                pass  # the user requested this output with the options

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
            now = [*troubles(self._session), *waiting_once(self._session)]
            for trouble in now:
                if trouble not in told:  # a problem is printed once, and again only after it had disappeared
                    stderr.print(f"! {trouble}", soft_wrap=True, markup=False)
            told = set(now)
            stderr.print(line(self._session), soft_wrap=True, markup=False)

    def _tell_once(self, told: set[str]) -> set[str]:
        """Print new texts only: where the gateway listens (a prototype takes free ports), and which simulated devices have
        recovered.

        `told` are the texts printed before; return the present ones.
        """
        now = set(ports(self._session))
        if (back := self._session.field_return) is not None and back.news:
            now.add(back.news)
        for text in sorted(now - told):
            stderr.print(f"  {text}", soft_wrap=True, markup=False)
        return now


def ports(session: RunSession) -> list[str]:
    """Return where the gateway serves tags (`serve`) and lets clients reach units (`bridge`), as texts."""
    return [f"{kind} {name}  ←  {front.listening}" for kind, name, front in fronts_of(session) if front.listening]


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
    if gateway is not None and (alarms := alarms_line(gateway.alarms)):
        parts.append(f"ALARMS={alarms}")
    if gateway is not None and not gateway.plc.alive:
        parts.append("PLC LOST")
    return " ".join(parts)


def _requests(bus: BusStatus) -> int:
    return bus.counters.get("requests", 0) or bus.counters.get("sdo_requests", 0)


def _p99(plc: PlcStatus) -> str:
    value = plc.lateness_us.get("p99")
    return "-" if value is None else f"{value:.0f}"


def render(session: RunSession) -> RenderableType:
    """Return the live table, fitted to the terminal's width."""
    gateway = session.gateway_status
    kind = "prototype" if session.options.prototype else "plant"
    left = session.options.duration_s
    clock = f"{session.elapsed_s:5.1f} s" + (f" of {left:.0f} s" if left else "")
    head = Text.assemble((f" {session.system.name} ", "bold reverse"), f" {kind}  {clock}  ", _states(session))
    parts: list[RenderableType] = [head, _devices(session), _foot(session)]
    parts += [Text(text, style="bold yellow") for text in interference(session)]
    parts += [Text(f"! {trouble}", style="red") for trouble in troubles(session)[-MAX_TROUBLES:]]
    if gateway is not None and (alarms := standing(gateway.alarms)):
        parts.append(alarm_table(dict(islice(alarms.items(), MOST_ALARMS))))
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
            Text("(secret)" if name in secrets else value_text(tag.value, "" if tag.text is UNSET else tag.text)),
            units.get(name, ""),
            Text(quality, COLOUR.get(tag.quality, "")),
            age_text(tag.age_s),
        )
    return table


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
