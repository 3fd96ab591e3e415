"""A device with a fast and a slow poll group: its profile, its configuration and its register bank."""

from __future__ import annotations

from fieldtwin.emulators.modbus.bank import CellSpan, MapBank
from fieldtwin.gateway.core.files.profile import DeviceProfile
from fieldtwin.gateway.devices.config import DeviceConfig

TWO_GROUPS = """
tags:
  fast: {at: "holding:0", poll: fast}
  slow: {at: "holding:10", poll: slow, access: rw}
  name: {at: "holding:20", type: string, registers: 2, poll: identity}
"""


def config(name: str, p: DeviceProfile, address: int, every_ms: int = 20, **more: object) -> DeviceConfig:
    poll = {"fast": every_ms, "slow": 3 * every_ms}
    return DeviceConfig(name, p, "bus", address, poll=poll, stale_after_ms=400, **more)  # type: ignore[arg-type]


def bank() -> MapBank:
    made = MapBank([CellSpan("holding", 0, 1), CellSpan("holding", 10, 1), CellSpan("holding", 20, 2)])
    made.poke("holding", 20, 0x6162, 0x6300)
    return made
