"""Collect the status of a gateway for the control channel."""

from __future__ import annotations

from msgspec import UNSET

from fieldtwin.gateway.core.values import TagValue
from fieldtwin.gateway.runtime.gateway import Gateway
from fieldtwin.gateway.runtime.gateway_status import (
    DeviceStatus,
    GatewayStatus,
    MailboxStatus,
    OutputStatus,
    PlcSeen,
    TagStatus,
    WritesStatus,
)


def describe(gateway: Gateway, now_ns: int, *, brief: bool = False) -> GatewayStatus:
    """Return devices, buses, tags with quality and age, outputs, mailboxes, and the PLC as the gateway sees it.

    A brief status has no tags, because thousands of them take longer than everything else.
    """
    outputs = gateway.outputs
    return GatewayStatus(
        devices=_devices(gateway, now_ns),
        buses={name: bus.status() for name, bus in gateway.buses.items()},
        tags={} if brief else _tags(gateway, now_ns),
        outputs=[
            OutputStatus(
                tag=o.tag,
                wanted=o.wanted,
                held=o.held,
                by=o.by,
                refused=o.refused == (o.wanted, o.by) or outputs.held_back(o),
            )
            for o in outputs.outputs
        ],
        writes=WritesStatus(
            allowed=outputs.allow_writes,
            done=outputs.writes,
            failed=outputs.failures,
            refused=outputs.refusals,
            repeated=outputs.rewrites,
            superseded=outputs.superseded,
            safe=outputs.safe_active,
        ),
        refusals=outputs.journal.status(),
        mailboxes={
            pump.driver.config.name: MailboxStatus(
                received=pump.driver.received,
                sent=pump.driver.sent,
                taken=pump.driver.taken,
                waits=pump.driver.mailbox_waits,
                queued=len(pump.driver.consumer.queue),
                dropped=pump.driver.consumer.dropped + pump.inbox.dropped,
                commands_refused=pump.commands_refused,
            )
            for pump in gateway.pumps
        },
        plc=PlcSeen(
            alive=gateway.plc_alive,
            age_ms=_finite(gateway.exchange.plc_age_ms(now_ns)),
            losses=gateway.plc_losses,
            stopped=gateway.exchange.plc_stopped,
        ),
        serve={server.config.name: server.status() for server in gateway.servers},
        bridge={bridge.config.name: bridge.status() for bridge in gateway.bridges},
        published=gateway.tags.published,
        logged=gateway.log.stored,
        log_dropped=gateway.log.dropped,
        alarms=gateway.alarms.statuses(now_ns),
    )


def _tags(gateway: Gateway, now_ns: int) -> dict[str, TagStatus]:
    """Return every tag. If the profile names a tag's values, the tag also has a `text` while its value is one of
    them."""
    names = {
        f"{driver.config.name}.{tag.name}": dict(tag.values)
        for driver in gateway.drivers.values()
        for tag in driver.profile.tags.values()
        if tag.values
    }
    return {name: _tag(gateway.tags.current(name, now_ns), now_ns, names.get(name, {})) for name in gateway.tags.names}


def _tag(seen: TagValue, now_ns: int, names: dict[int, str]) -> TagStatus:
    value = seen.value.hex() if isinstance(seen.value, bytes) else seen.value
    return TagStatus(
        value=value,
        quality=str(seen.quality),
        reason=str(seen.reason),
        age_s=seen.age_s(now_ns) if seen.t_ns else None,
        text=names[int(value)] if isinstance(value, int | float) and value in names else UNSET,
    )


def _devices(gateway: Gateway, now_ns: int) -> dict[str, DeviceStatus]:
    found: dict[str, DeviceStatus] = {}
    for bus in gateway.buses.values():
        found |= bus.device_statuses(now_ns)
    return {name: found[name] for name in gateway.drivers}


def _finite(number: float) -> float | None:
    return None if number == float("inf") else number
