"""The present problems of a run as text: errors, lost devices, refused outputs, and why the PLC does not follow its programs.

Everything comes from the session's statuses; this module prints nothing.
"""

from __future__ import annotations

from typing import Any

import msgspec

from fieldtwin.cli.plc.views import value_text, waiting_texts
from fieldtwin.gateway.runtime.gateway_status import FrontStatus, GatewayStatus
from fieldtwin.results.trace import refusal_text
from fieldtwin.run.live.session import RunSession

MAX_FORCES = 6
READ_ONLY = "read-only"
"""The cause of a refusal that is intended: the plant runs read-only."""


def fronts_of(session: RunSession) -> list[tuple[str, str, FrontStatus]]:
    """Return kind (``serve`` or ``bridge``), name and status of each server and bridge of the gateway."""
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
    found += [f"{kind} {name}: {front.error}" for kind, name, front in fronts_of(session) if front.error]
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


def waiting_once(session: RunSession) -> list[str]:
    """Return the programs that wait for their start, without the time that they have waited, so that a log reports each once."""
    waiting = session.plc_status.waiting if session.plc_status is not None else {}
    return [f"program {program} has not started; missing {start.reason}" for program, start in waiting.items()]


def forces_text(forces: dict[str, Any]) -> str:
    """Return the forces as text such as ``ctd.pressure = 5 by ada, ...``: the first few of them, and the number of the rest."""
    shown = [
        f"{tag} = {value_text(force['value'])}" + (f" by {force['by']}" if force["by"] else "")
        for tag, force in list(forces.items())[:MAX_FORCES]
    ]
    more = len(forces) - len(shown)
    return ", ".join(shown) + (f" and {more} more" if more else "")
