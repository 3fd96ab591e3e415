"""A gateway's status as plain data, for the control channel."""

from __future__ import annotations

from typing import Any

from fieldtwin.gateway.devices.transmitter import TransmitterDriver
from fieldtwin.gateway.runtime.buses.canopen_bus import CanopenBus
from fieldtwin.gateway.runtime.buses.modbus_bus import ModbusBus
from fieldtwin.gateway.runtime.gateway import Gateway


def describe(gateway: Gateway, now_ns: int) -> dict[str, Any]:
    """Return devices, buses, tags with quality and age, outputs, mailboxes, and the PLC as the gateway sees it."""
    return {
        "devices": _devices(gateway, now_ns),
        "buses": {name: _bus(bus) for name, bus in gateway.buses.items()},
        "tags": _tags(gateway, now_ns),
        "outputs": [
            {
                "tag": o.tag,
                "wanted": o.wanted,
                "held": o.held,
                "by": o.by,
                "refused": o.refused == (o.wanted, o.by) or gateway.outputs.held_back(o),
            }
            for o in gateway.outputs.outputs
        ],
        "writes": {
            "allowed": gateway.outputs.allow_writes,
            "done": gateway.outputs.writes,
            "failed": gateway.outputs.failures,
            "refused": gateway.outputs.refusals,
            "repeated": gateway.outputs.rewrites,
            "superseded": gateway.outputs.superseded,
            "safe": gateway.outputs.safe_active,
        },
        "refusals": gateway.outputs.journal.describe(),
        "mailboxes": {
            pump.driver.config.name: {
                "received": pump.driver.received,
                "sent": pump.driver.sent,
                "taken": pump.driver.taken,
                "waits": pump.driver.mailbox_waits,
                "queued": len(pump.driver.consumer.queue),
                "dropped": pump.driver.consumer.dropped + pump.inbox.dropped,
                "commands_refused": pump.commands_refused,
            }
            for pump in gateway.pumps
        },
        "plc": {
            "alive": gateway.plc_alive,
            "age_ms": _finite(gateway.exchange.plc_age_ms(now_ns)),
            "losses": gateway.plc_losses,
            "stopped": gateway.exchange.plc_stopped,
        },
        "serve": {server.config.name: server.describe() for server in gateway.servers},
        "bridge": {bridge.config.name: bridge.describe() for bridge in gateway.bridges},
        "published": gateway.tags.published,
        "logged": gateway.log.stored,
        "log_dropped": gateway.log.dropped,
    }


def _tags(gateway: Gateway, now_ns: int) -> dict[str, Any]:
    """Return every tag. If the profile names a tag's values, the tag also has a `text` while its value is one of
    them."""
    found: dict[str, Any] = {name: gateway.tags.current(name, now_ns).describe(now_ns) for name in gateway.tags.names}
    for driver in gateway.drivers.values():
        for tag in driver.profile.tags.values():
            shown = found.get(f"{driver.config.name}.{tag.name}")
            if tag.values and shown is not None:
                text = dict(tag.values).get(shown["value"])
                found[f"{driver.config.name}.{tag.name}"] = {**shown, **({"text": text} if text is not None else {})}
    return found


def _devices(gateway: Gateway, now_ns: int) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for bus in gateway.buses.values():
        if isinstance(bus, CanopenBus):
            for status in bus.nodes.values():
                driver = status.driver
                found[driver.config.name] = {
                    "bus": bus.config.name,
                    "address": driver.node,
                    "online": status.online,
                    "error": status.error or status.conflict,
                    "conflicts": status.conflicts,
                    "conflict": status.conflict,
                    "identity_error": driver.identity_error,
                    "boots": status.boots,
                    "bring_ups": status.bring_ups,
                    "emcys": status.emcys,
                    "emcy": [f"{code:04X}h" for code in status.emcy_log.active],
                    "emcy_log": status.emcy_log.describe(now_ns),
                    "errors": driver.malformed_pdos + status.poll_errors,
                    "polls": status.polls,
                    "tpdos": {
                        str(t.number): {"cob_id": f"{t.cob_id:03X}h", "tags": list(t.tags), "frames": t.frames}
                        for t in driver.tpdos
                    },
                    "rpdos": {str(r.number): [tag for tag in r.tags if tag] for r in driver.rpdos},
                    "rpdos_sent": status.writes.frames,
                }
        elif isinstance(bus, ModbusBus):
            for state in bus.devices:
                found[state.driver.config.name] = {
                    "bus": bus.config.name,
                    "address": state.driver.config.address,
                    "online": state.online,
                    "error": state.error,
                    "identity_error": state.driver.identity_error,
                    "polls": state.polls,
                    "errors": state.poll_errors,
                    "samples_missed": state.driver.samples_missed,
                    "mailbox": isinstance(state.driver, TransmitterDriver),
                }
    return {name: found[name] for name in gateway.drivers}


def _bus(bus: Any) -> dict[str, Any]:
    return {
        "endpoint": str(bus.config.endpoint),
        "connected": bus.connected,
        "opens": bus.opens,
        "local": sorted({address for address in bus.locals if address}),
        "error": bus.error,
        "counters": dict(bus.totals()),
        "latency": bus.latency.describe(),
        **(
            {"not_produced": bus.not_produced, "sync_producers": bus.sync_watch.verdict}
            if isinstance(bus, CanopenBus)
            else {}
        ),
    }


def _finite(number: float) -> float | None:
    return None if number == float("inf") else number
