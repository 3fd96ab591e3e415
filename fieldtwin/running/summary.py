"""The verdict on a run: what both sides counted, what was published, which states were seen, and whether all of it agrees."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Protocol

from fieldtwin.__about__ import __version__
from fieldtwin.running.shore import Shore
from fieldtwin.running.states import StateWatch, expected_states
from gateway.core.endpoint import Endpoint
from twin.system import System


class Options(Protocol):
    @property
    def prototype(self) -> bool: ...


class Named(Protocol):
    @property
    def name(self) -> str: ...


class Oracle(Protocol):
    """What compared published values with held ones."""

    checked: int
    wrong_count: int
    wrong: list[str]

    def describe(self) -> dict[str, Any]: ...


class Run(Protocol):
    """A run that is over: of processes on this host, or in virtual time."""

    @property
    def options(self) -> Options: ...

    @property
    def system(self) -> System: ...

    @property
    def instance(self) -> Named: ...

    @property
    def errors(self) -> Iterable[str]: ...

    @property
    def oracle(self) -> Oracle: ...

    @property
    def states(self) -> StateWatch: ...

    @property
    def shore(self) -> Shore | None: ...

    @property
    def mapping(self) -> dict[Endpoint, Endpoint]: ...

    @property
    def gateway_status(self) -> dict[str, Any] | None: ...

    @property
    def plc_status(self) -> dict[str, Any] | None: ...

    @property
    def field_status(self) -> dict[str, Any] | None: ...

    @property
    def counted_before(self) -> dict[str, dict[str, int]]: ...

    @property
    def outputs_confirmed_safe(self) -> bool | None: ...

    @property
    def elapsed_s(self) -> float: ...

    @property
    def disturbed(self) -> bool:
        """Whether faults were put in: then both sides need not count alike."""
        ...

    @property
    def calm(self) -> bool:
        """Whether the last fault was over for so long that all must be well again."""
        ...


def summarise(run: Run) -> dict[str, Any]:
    """Plain data for `--json` and for people. `ok` is False when any check failed; `errors` says which and why."""
    gateway = run.gateway_status or {}
    plc = run.plc_status or {}
    exchanges = _exchanges(run)
    checks = [*_plc_checks(plc), *_loss_checks(gateway)]
    if run.calm:
        checks = [*_device_checks(gateway), *_output_checks(gateway), *checks]
    if run.options.prototype:
        checks += _oracle_checks(run) + ([] if run.disturbed else _exchange_checks(exchanges) + _state_checks(run))
    errors = [*run.errors, *checks]
    return {
        "fieldtwin": __version__,
        "system": run.system.name,
        "system_hash": run.system.hash,
        "prototype": run.options.prototype,
        "instance": run.instance.name,
        "duration_s": round(run.elapsed_s, 3),
        "mapping": {str(plant): str(target) for plant, target in run.mapping.items()},
        "devices": _devices(gateway, run.field_status or {}),
        "states": {program: run.states.sequence(program) for program in run.states.programs},
        "transitions": {p: [[round(t, 3), s] for t, s in seen] for p, seen in run.states.transitions.items()},
        "exchanges": exchanges,
        "published": {"values": gateway.get("published", 0), **run.oracle.describe()},
        "mailboxes": gateway.get("mailboxes", {}),
        "far_end": run.shore.describe() if run.shore else None,
        "field": back.describe() if (back := getattr(run, "field_return", None)) else None,
        "thread": getattr(run, "thread_status", None),
        "learnt": gateway.get("learnt", {}),
        "logged": gateway.get("logged", 0),
        "writes": gateway.get("writes", {}),
        "outputs_safe": run.outputs_confirmed_safe,
        "plc": {
            k: plc[k]
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
            )
            if k in plc
        },
        "tags": gateway.get("tags", {}),
        "errors": errors,
        "ok": not errors,
    }


def _devices(gateway: dict[str, Any], field: dict[str, Any]) -> dict[str, Any]:
    """How each device was, and what stood in for it, where something did."""
    emulated = field.get("devices", {})
    return {
        name: {"state": "good" if d["online"] else "bad", "error": d["error"]}
        | ({"plays": emulated[name]["plays"]} if name in emulated else {})
        for name, d in gateway.get("devices", {}).items()
    }


def _exchanges(run: Run) -> dict[str, Any]:
    """Requests and replies a bus, as counted by the gateway and by the emulators on it."""
    gateway, field = run.gateway_status or {}, run.field_status or {}
    out: dict[str, Any] = {}
    for name, bus in gateway.get("buses", {}).items():
        counters = bus["counters"]
        can = run.system.buses[name].endpoint.is_can
        prefix = "sdo_" if can else ""
        row: dict[str, Any] = {
            "gateway": {
                "requests": counters.get(f"{prefix}requests", 0),
                # An exception is a reply to whoever sends it. The SDO counters have no such split.
                "replies": counters.get(f"{prefix}replies", 0) + counters.get("sdo_aborts" if can else "exceptions", 0),
            },
            "timeouts": counters.get(f"{prefix}timeouts", 0),
            "crc_errors": counters.get("crc_errors", 0),
        }
        if can:
            row["gateway"]["pdos"] = counters.get("pdos", 0)
            row["gateway"]["heartbeats"] = counters.get("heartbeats", 0)
        devices = [d for d in run.system.devices_on(name) if d.name in field.get("devices", {})]
        if devices:
            row["emulators"] = {
                what: sum(
                    field["devices"][d.name]["counters"][what] - run.counted_before.get(d.name, {}).get(what, 0)
                    for d in devices
                )
                for what in ("requests", "replies")
            }
        if any(d.name == getattr(run, "lent", "") for d in devices):
            row["shared"] = "the digital thread"
        out[name] = row
    return out


def _exchange_checks(exchanges: dict[str, Any]) -> list[str]:
    """Both sides count the same; but a reply that came too late, or damaged, was one for its sender only. Where somebody else
    asks the same device, nobody can say."""
    failed = []
    for bus, row in exchanges.items():
        excused = {"requests": 0, "replies": row["timeouts"] + row["crc_errors"]}
        for what in ("requests", "replies"):
            if (
                "shared" not in row
                and "emulators" in row
                and not 0 <= row["emulators"][what] - row["gateway"][what] <= excused[what]
            ):
                failed.append(
                    f"{bus}: the gateway counted {row['gateway'][what]} {what}, the emulators {row['emulators'][what]}"
                )
        if "emulators" in row and not row["emulators"]["replies"]:
            failed.append(f"{bus}: nothing was exchanged")
    return failed


def _device_checks(gateway: dict[str, Any]) -> list[str]:
    return [f"{name}: {d['error']}" for name, d in gateway.get("devices", {}).items() if not d["online"] or d["error"]]


def _output_checks(gateway: dict[str, Any]) -> list[str]:
    """An output that the device does not hold at the end, though it may be written and the device is there."""
    devices = gateway.get("devices", {})
    return [
        f"{o['tag']}: {o['wanted']:g} was commanded by {o['by']}, and the device does not hold it"
        for o in gateway.get("outputs", [])
        if o["wanted"] is not None
        and o["held"] != o["wanted"]
        and not o["refused"]
        and devices.get(o["tag"].partition(".")[0], {}).get("online")
    ]


def _plc_checks(plc: dict[str, Any]) -> list[str]:
    if not plc:
        return []  # its death is in the run's errors already
    error = plc.get("error")
    return [f"PLC: {error}"] if error else []


def _loss_checks(gateway: dict[str, Any]) -> list[str]:
    failed = [
        f"{n}: {m['dropped']} messages were dropped" for n, m in gateway.get("mailboxes", {}).items() if m["dropped"]
    ]
    if gateway.get("log_dropped"):
        failed.append(f"{gateway['log_dropped']} entries of the exchange log were dropped")
    if gateway.get("store_error"):
        failed.append(gateway["store_error"])
    return failed


def _oracle_checks(run: Run) -> list[str]:
    oracle = run.oracle
    if oracle.wrong_count:
        return [f"{oracle.wrong_count} published values were never held by their device", *oracle.wrong]
    return [] if oracle.checked else ["no value was published as good"]


def _state_checks(run: Run) -> list[str]:
    """The states must be those that the commands of the far end ask for, in order, beginning with STANDBY."""
    if run.shore is None:
        return []
    expected = expected_states(run.shore.commands_sent)
    failed = []
    for program in run.states.relays:
        seen = run.states.sequence(program)
        if seen and seen != expected:
            failed.append(f"{program}: the commands ask for {' '.join(expected)}, seen were {' '.join(seen)}")
    return failed
