"""Apply a new configuration to a running gateway: timing, limits, scaling and safe values.

It takes effect between two polls, and no poll is lost or doubled. Only `remote` (whether remote commands are accepted) takes
effect at once.

Buses, devices, addresses, tags and their bindings must be unchanged: the caller has compared the files
(`fieldtwin.twin.plant.reloading`). A device has either its old configuration or its new one, never a mixture; stored values are
decoded again immediately. This module reads no file.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import msgspec

from fieldtwin.gateway.core.files.profile import DeviceProfile
from fieldtwin.gateway.core.values import Quality, Reason, TagValue
from fieldtwin.gateway.runtime.buses.pending_config import AnyDriver, PendingConfig
from fieldtwin.gateway.runtime.gateway import Gateway, GatewayConfig, stale_limits

OF_DECODING = frozenset({Reason.NONE, Reason.OUT_OF_RANGE, Reason.NOT_A_NUMBER, Reason.SENTINEL})
"""Reasons for bad quality that result from decoding a value."""


async def reconfigure(gateway: Gateway, config: GatewayConfig) -> None:
    """Apply `config`. Return when every device uses it; this may take until the present read of a long group has ended."""
    gateway.config = replace(gateway.config, buses=config.buses, devices=config.devices, remote=config.remote)
    for pump in gateway.pumps:
        pump.remote = config.remote
    coming = []
    for name, bus in gateway.buses.items():
        on_it = {d.name: d for d in config.devices.values() if d.bus == name}
        coming.append(PendingConfig(config.buses[name], on_it, _Taking(gateway, on_it)))
        bus.reconfigure(coming[-1])
    for each in coming:
        await each.done.wait()


class _Taking:
    """Applies a driver's new configuration to the gateway's tags, outputs and buses. All changes take effect in one step."""

    def __init__(self, gateway: Gateway, devices: Iterable[str]) -> None:
        drivers = [gateway.drivers[name] for name in devices]
        self._gateway = gateway
        self._before = {d.config.name: d.profile for d in drivers}
        self._sent = {d.config.name: gateway.outputs.as_sent(d) for d in drivers}

    def __call__(self, driver: AnyDriver) -> None:
        gateway, name = self._gateway, driver.config.name
        gateway.let_trigger(driver)
        for tag, stale_ms in stale_limits(driver).items():
            gateway.tags.restate(tag, stale_ms)
        gateway.alarms.look_again()
        if driver.profile != self._before[name]:
            self._understand(driver, self._before[name])
        gateway.outputs.restated(driver, self._sent[name])
        gateway.complete_outputs(driver)

    def _understand(self, driver: AnyDriver, before: DeviceProfile) -> None:
        """Decode the last values of the device again with the new profile.

        Their age stays unchanged, and so does a bad quality whose reason is not in `OF_DECODING`.
        """
        tags, name = self._gateway.tags, driver.config.name
        changed = {n for n, tag in driver.profile.tags.items() if tag != before.tags[n] and tag.readable}
        for n in changed | {n for n, t in driver.profile.tags.items() if t.scale_by in changed}:
            tag, held = driver.profile.tags[n], tags.held(f"{name}.{n}")
            if held.raw:
                of = tags.held(f"{name}.{tag.scale_by}") if tag.scale_by is not None else None
                tags.amend(f"{name}.{n}", _kept(held, driver.understood(n, held, of)))


def _kept(held: TagValue, anew: TagValue) -> TagValue:
    if held.quality is Quality.GOOD or held.reason in OF_DECODING:
        return anew
    return msgspec.structs.replace(held, value=anew.value)
