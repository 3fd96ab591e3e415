"""The verdict on a run: the counters of gateway and emulators, the published values and the observed states must agree."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import msgspec

from fieldtwin.__about__ import __version__
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.runtime.gateway_status import BusStatus, GatewayStatus, RefusalsStatus
from fieldtwin.plc.cycle.task import StopReason
from fieldtwin.plc.status import PlcStatus
from fieldtwin.results.trace import refusal_text
from fieldtwin.run.processes.states import SeenStates, expected_states
from fieldtwin.twin.prototype.field_status import FieldStatus
from fieldtwin.twin.site.system import System
from fieldtwin.twin.thread.status import PlantThreadStatus

MOST_REFUSED = 10
"""Largest number of refused outputs that a summary names one by one."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RunFacts:
    """The facts of a run that is over, of processes on this host or in virtual time."""

    prototype: bool
    system: System
    instance: str
    elapsed_s: float
    disturbed: bool
    """Faults were injected, or the simulated field devices were lost or created again, so the counts may differ."""
    calm: bool
    """There were no faults, or the last one has been over for long enough that the system must have recovered."""
    errors: Sequence[str]
    """The errors that were recorded during the run."""
    gateway: GatewayStatus | None
    """The last status of the gateway; None if it did not answer at the end. The same applies to `plc` and `field`."""
    plc: PlcStatus | None
    field: FieldStatus | None
    counted_before: Mapping[str, Mapping[str, int]]
    """Per device, the requests and replies that its emulator had counted before the run; `clients_before` per bus and client."""
    clients_before: Mapping[str, Mapping[str, Mapping[str, int]]]
    mapping: Mapping[Endpoint, Endpoint]
    """The endpoint that replaces each endpoint of the plant in the prototype."""
    published: Mapping[str, Any]
    """How many published values were checked against those that the devices held, and the first wrong ones."""
    wrong_messages: Sequence[str] = ()
    """Errors of commands that reached the gateway through a mailbox twice, too late or changed. Detected in virtual time only."""
    invariants: Sequence[Mapping[str, Any]] = ()
    """The results of the system file's invariants, and the errors that follow from them."""
    invariant_errors: Sequence[str] = ()
    states: SeenStates
    topside: Mapping[str, Any] | None = None
    """The status of the topside controller; None if the run had none."""
    commands_sent: Sequence[int] = ()
    """The periods that the topside controller commanded, in order."""
    outputs_confirmed_safe: bool | None
    """None if there were no outputs to make safe."""
    field_contact: Mapping[str, Any] | None = None
    """The losses of a remote field simulator; None if it runs on this host."""
    thread: PlantThreadStatus | None = None
    """The last status of the digital thread."""
    delegated: str = ""
    """The transmitter whose mailboxes the digital thread uses."""
    may_refuse: Collection[str] = ()
    """Tags of which a scenario expects that their outputs are refused."""


GATEWAY_GONE = "the gateway did not answer at the end: its published values and outputs are not known"
NOT_CALM = "whether devices and outputs were good at the end, because faults were injected"
"""The message of a run that had faults until its end, or until shortly before."""


def summarise(run: RunFacts) -> dict[str, Any]:
    """Return plain data for `--json` and for printing. `ok` is False when any check failed; `errors` lists the reasons."""
    gateway, plc, field = run.gateway, run.plc, run.field
    exchanges = _exchanges(run)
    checks = [*_plc_checks(plc), *(_loss_checks(gateway) if gateway is not None else [GATEWAY_GONE])]
    disturbed = run.prototype and run.disturbed
    if run.calm and gateway is not None:
        checks = [*_device_checks(gateway, disturbed), *_output_checks(gateway), *checks]
    if run.prototype:
        checks += _published_checks(run) + ([] if run.disturbed else exchange_checks(exchanges) + _state_checks(run))
    told = msgspec.to_builtins(plc) if plc is not None else {}
    if gateway is not None:
        checks += _refusal_checks(gateway.refusals, run.may_refuse, disturbed=disturbed)
    seen = msgspec.to_builtins(gateway) if gateway is not None else {}
    failures = (
        dict.fromkeys(field.failures.values()) if field is not None else ()
    )  # one simulation may have many devices
    errors = [*run.errors, *failures, *run.invariant_errors, *checks]
    return {
        "fieldtwin": __version__,
        "system": run.system.name,
        "system_hash": run.system.hash,
        "prototype": run.prototype,
        "instance": run.instance,
        "duration_s": round(run.elapsed_s, 3),
        "warnings": list(run.system.warnings),
        "mapping": {str(plant): str(target) for plant, target in run.mapping.items()},
        "devices": _devices(gateway, field),
        "states": {program: list(seen) for program, seen in run.states.sequences.items()},
        "transitions": {p: [[round(t, 3), s] for t, s in seen] for p, seen in run.states.transitions.items()},
        "exchanges": exchanges,
        "faults": msgspec.to_builtins(field.struck) if field is not None else [],
        "published": {"values": seen.get("published"), **run.published},
        "mailboxes": seen.get("mailboxes", {}),
        "topside": run.topside,
        "field": run.field_contact,
        "thread": msgspec.to_builtins(run.thread),
        "learnt": seen.get("learnt", {}),
        "logged": seen.get("logged", 0),
        "writes": seen.get("writes", {}),
        "refused": msgspec.to_builtins(gateway.refusals.entries) if gateway is not None else [],
        "invariants": list(run.invariants),
        "outputs_safe": run.outputs_confirmed_safe,
        **({"alarms": seen["alarms"]} if seen.get("alarms") else {}),
        "plc": {
            k: told[k]
            for k in (
                "state",
                "stop_reason",
                "scans",
                "missed_periods",
                "overruns",
                "lateness_us",
                "duration_us",
                "realtime",
                "error",
                "acts",
                "forces",
                "waiting",
                "started_without",
            )
            if told.get(k) is not None
        },
        "tags": seen.get("tags", {}),
        "errors": errors,
        "not_judged": [] if run.calm else [NOT_CALM],
        "ok": not errors,
    }


def _devices(gateway: GatewayStatus | None, field: FieldStatus | None) -> dict[str, Any]:
    """Return the state of each device, and the model or recording that replaced it, if any."""
    emulated = field.devices if field is not None else {}
    return {
        name: {"state": "good" if d.online else "bad", "error": d.error}
        | ({"note": d.unstarted} if d.unstarted else {})
        | ({"plays": emulated[name].plays} if name in emulated else {})
        for name, d in (gateway.devices if gateway is not None else {}).items()
    }


def _exchanges(run: RunFacts) -> dict[str, Any]:
    """Return the requests and replies per bus, as counted by the gateway and by its emulators."""
    field = run.field
    emulated = field.devices if field is not None else {}
    out: dict[str, Any] = {}
    for name, bus in (run.gateway.buses if run.gateway is not None else {}).items():
        counters = bus.counters
        can = run.system.buses[name].endpoint.is_can
        prefix = "sdo_" if can else ""
        row: dict[str, Any] = {
            "gateway": {
                "requests": counters.get(f"{prefix}requests", 0),
                # A client counts an exception as a reply. The SDO counters do not separate the two.
                "replies": counters.get(f"{prefix}replies", 0) + counters.get("sdo_aborts" if can else "exceptions", 0),
            },
            "timeouts": counters.get(f"{prefix}timeouts", 0),
            "crc_errors": counters.get("crc_errors", 0),
        }
        if can:
            row["gateway"]["pdos"] = counters.get("pdos", 0)
            row["gateway"]["heartbeats"] = counters.get("heartbeats", 0)
        devices = [d for d in run.system.devices_on(name) if d.name in emulated]
        if devices:
            row["unanswered_at_stop"] = unanswered_at_stop(row, len(devices))
            row["emulators"] = {
                what: sum(
                    emulated[d.name].counters[what] - run.counted_before.get(d.name, {}).get(what, 0) for d in devices
                )
                for what in ("requests", "replies")
            }
            others = _others(
                bus, field.clients.get(name, {}) if field is not None else {}, run.clients_before.get(name, {})
            )
            if any(others.values()):
                row["others"] = others
                # The bus counts a request when it is sent, the node when it receives it. A third party is not stopped
                # before the counts are read, so it may have one request in progress at each node.
                row["under_way"] = len(devices) if can else 0
                row["emulators"] = {what: number - others[what] for what, number in row["emulators"].items()}
        if any(d.name == run.delegated for d in devices):
            row["shared"] = "the digital thread"
        out[name] = row
    return out


def unanswered_at_stop(row: dict[str, Any], devices: int) -> int:
    """Return how many requests the gateway had under way when it stopped: at most one for each of its `devices`.

    Such a request has neither a reply nor a timeout on the gateway's side, but the emulator may have answered it.
    """
    answered = row["gateway"]["replies"] + row["timeouts"] + row["crc_errors"]
    return min(devices, max(0, int(row["gateway"]["requests"]) - int(answered)))


def _others(
    bus: BusStatus, clients: Mapping[str, Mapping[str, int]], before: Mapping[str, Mapping[str, int]]
) -> dict[str, int]:
    """Return the traffic of third parties with the emulators of a bus: that of clients whose address is not the gateway's.

    On a kernel CAN bus, where frames have no sender, these are the SDO requests that the gateway did not send itself.
    If no client has an address of the gateway, addresses are translated on the way and the clients cannot be
    distinguished.
    """
    ours = set(bus.local)
    if not clients:
        number = bus.counters.get("foreign_sdo_requests", 0)
        return {"requests": number, "replies": number}
    if not ours & clients.keys():
        return {"requests": 0, "replies": 0}
    return {
        what: sum(c[what] - before.get(name, {}).get(what, 0) for name, c in clients.items() if name not in ours)
        for what in ("requests", "replies")
    }


def exchange_checks(exchanges: dict[str, Any]) -> list[str]:
    """Compare the gateway's and the emulators' counts of each bus; return one sentence for each difference.

    A reply that was late, damaged, or still in transit when the gateway stopped is counted by the emulators only. A
    device that the digital thread also uses is not compared.
    """
    failed = []
    for bus, row in exchanges.items():
        under_way = row.get("under_way", 0)
        unanswered = row.get("unanswered_at_stop", 0)
        excused = {"requests": under_way, "replies": row["timeouts"] + row["crc_errors"] + under_way + unanswered}
        for what in ("requests", "replies"):
            if (
                "shared" not in row
                and "emulators" in row
                and not -under_way <= row["emulators"][what] - row["gateway"][what] <= excused[what]
            ):
                failed.append(
                    f"{bus}: the gateway counted {row['gateway'][what]} {what}, the emulators {row['emulators'][what]}"
                )
        if "emulators" in row and not row["emulators"]["replies"]:
            failed.append(f"{bus}: nothing was exchanged")
    return failed


def _device_checks(gateway: GatewayStatus, disturbed: bool) -> list[str]:
    """Return the errors of devices.

    A fault that doubles frames looks like two nodes with one ID, so this is not an error when the run is `disturbed`.
    """
    return [
        f"{name}: {d.error}"
        for name, d in gateway.devices.items()
        if not d.online or (d.error and not (disturbed and d.error == d.conflict))
    ]


def _output_checks(gateway: GatewayStatus) -> list[str]:
    """Return the outputs that an online device does not hold at the end, although they may be written."""
    online = {name for name, device in gateway.devices.items() if device.online}
    return [
        f"{o.tag}: {o.wanted:g} was commanded by {o.by}, but the device has a different value"
        for o in gateway.outputs
        if o.wanted is not None and o.held != o.wanted and not o.refused and o.tag.partition(".")[0] in online
    ]


def _refusal_checks(refusals: RefusalsStatus, expected: Collection[str], *, disturbed: bool) -> list[str]:
    """Return the errors of refused outputs of programs.

    A refusal counts if the program or the configuration is wrong, and, in a run without faults, if the device refused.
    A refusal by design, one that is retried, and one of a client's request do not fail a run.
    """
    found: dict[tuple[str, str, str], str] = {}
    faults = ("program",) if disturbed else ("program", "device")
    for entry in refusals.entries:
        if entry.fault in faults and entry.tag not in expected:
            found[entry.tag, entry.cause, entry.place] = refusal_text(entry.tag, msgspec.structs.asdict(entry))
    told = list(found.values())
    if len(told) > MOST_REFUSED:
        told[MOST_REFUSED:] = [f"{len(told) - MOST_REFUSED} more outputs were refused"]
    if not found and not expected and any(refusals.faults.get(fault) for fault in faults):
        told = ["too many outputs of programs were refused, so the first ones are not listed: see the audit log"]
    return told


def _plc_checks(plc: PlcStatus | None) -> list[str]:
    if plc is None:
        return []  # the run's errors already contain the end of the PLC
    # A stopped PLC still lists the programs that never ran.
    failed = [
        f"PLC: program {program} has not started: it waits for {start.reason}" for program, start in plc.waiting.items()
    ]
    if plc.stops.count:
        times = "once" if plc.stops.count == 1 else f"{plc.stops.count} times"
        failed.append(
            f"PLC: stopped without a request {times}, and restarted after that; the last time: {plc.stops.last}"
        )
    error = plc.error
    told = failed and (plc.state == "waiting" or plc.stop_reason == StopReason.NOT_STARTED.value)
    return [f"PLC: {error}", *failed] if error and not told else failed


def _loss_checks(gateway: GatewayStatus) -> list[str]:
    failed = [f"{n}: {m.dropped} messages were dropped" for n, m in gateway.mailboxes.items() if m.dropped]
    if gateway.log_dropped:
        failed.append(f"{gateway.log_dropped} entries of the exchange log were dropped")
    if gateway.store_error:
        failed.append(gateway.store_error)
    return failed + [f"{name}: {bus.sync_producers}" for name, bus in gateway.buses.items() if bus.sync_producers]


def _published_checks(run: RunFacts) -> list[str]:
    """Check that the devices held the published values, and that the gateway took no message that was not sent."""
    published, messages = run.published, list(run.wrong_messages)
    if published["wrong"]:
        told = f"{published['wrong']} published values never occurred in their device"
        return [told, *published["examples"], *messages]
    if not run.system.devices:  # a PLC that only a client of its servers uses
        return messages
    return messages if published["checked"] else ["no value was published with good quality", *messages]


def _state_checks(run: RunFacts) -> list[str]:
    """Check that the states are those that the topside controller's commands require, in order, beginning with STANDBY."""
    if run.topside is None:
        return []
    expected = expected_states(run.commands_sent)
    failed = []
    for program in run.states.relays:
        seen = list(run.states.sequences.get(program, ()))
        if seen and seen != expected:
            failed.append(f"{program}: the commands require {' '.join(expected)}, observed {' '.join(seen)}")
    return failed
