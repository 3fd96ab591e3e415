"""`start: fresh` on a running system: PLC, simulations and devices are reset, without restarting a container.

The order matters. The PLC is reset first and stays paused, so that no scan sees values of the old devices and no output
of the old run reaches a new device. Then the devices are reset, the gateway reads all of them, and the PLC continues.
"""

from __future__ import annotations

import asyncio

from fieldtwin.gateway.core.control import ControlClient
from fieldtwin.gateway.core.errors import ReplyTimeout
from fieldtwin.gateway.runtime.gateway_status import GatewayStatus
from fieldtwin.plc.status import PlcStatus
from fieldtwin.run.benches.field_lease import FieldLease

BY = "fieldtwin test, start: fresh"
WITHIN_S = 60.0
"""Time limit of a reset in seconds. It is long, because the gateway retries a silent device at growing intervals, and a busy
host starts slowly.
"""
SCANS_WITHIN_S = 10.0
LOOK_EVERY_S = 0.05


async def make_fresh(lease: FieldLease, gateway: ControlClient, plc: ControlClient) -> None:
    """Reset the system, and return when the PLC runs from its initial state on values of the new devices. Forces and retained
    values are removed.

    Raises `ReplyTimeout` where a simulated device is not back within `WITHIN_S` seconds. The PLC is not left paused.
    """
    await plc.call("pause", by=BY)
    try:
        await plc.call("unforce", all=True, by=BY)
        await plc.call("restart", cold=True, by=BY)
        made_ns = await lease.fresh()
        await _all_read(gateway, made_ns)
        # this also clears the inputs that the PLC received while it was paused
        await plc.call("restart", cold=True, by=BY)
    finally:
        await plc.call("go", by=BY)
    await programs_scan(plc)


async def programs_scan(plc: ControlClient) -> None:
    """Wait until the programs have had the inputs that they need before their first scan, at most `SCANS_WITHIN_S` seconds.

    The scenario decides whether a longer wait is an error.
    """
    loop = asyncio.get_running_loop()
    deadline_s = loop.time() + SCANS_WITHIN_S
    while (await plc.ask("get", PlcStatus, brief=True)).state in (
        "ready",
        "paused",
        "waiting",
    ) and loop.time() < deadline_s:
        await asyncio.sleep(LOOK_EVERY_S)


async def _all_read(gateway: ControlClient, since_ns: int) -> None:
    """Wait until the gateway has read every device after `since_ns`, on the host's monotonic clock."""
    loop = asyncio.get_running_loop()
    deadline_s = loop.time() + WITHIN_S
    while missing := await _not_read(gateway, since_ns):
        if loop.time() > deadline_s:
            raise ReplyTimeout(
                f"no fresh start: the gateway has not read {', '.join(missing)} within {WITHIN_S:g} s after the devices "
                "were created again"
            )
        await asyncio.sleep(LOOK_EVERY_S)


async def _not_read(gateway: ControlClient, since_ns: int) -> list[str]:
    """Return the devices that are not online, or whose values are all older than `since_ns`."""
    status = await gateway.ask("get", GatewayStatus)
    tags = (await gateway.call("watch", names=list(status.tags)))["tags"]
    newest: dict[str, int] = {}
    for name, (value, _, _, t_ns) in tags.items():
        device = name.partition(".")[0]
        newest[device] = max(newest.get(device, 0), t_ns if value is not None else 0)
    return [
        name
        for name, device in status.devices.items()
        if not device.online or (newest.get(name) and newest[name] < since_ns)
    ]
