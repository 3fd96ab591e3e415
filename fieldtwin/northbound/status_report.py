"""The reports with which the process of a server of tags tells the gateway its status."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import msgspec

from fieldtwin.gateway.core.clock import NS_PER_S, Clock
from fieldtwin.gateway.core.errors import FieldtwinError
from fieldtwin.gateway.runtime.gateway_status import ServerStatus
from fieldtwin.twin.plant.channel import Channel

REPORT_EVERY_NS = NS_PER_S


async def report_status(run_dir: Path, server: str, status: Callable[[], ServerStatus], clock: Clock) -> None:
    """Report the status of a server to the gateway once a second, until cancelled.

    A gateway that does not answer is asked again: without a gateway no client of the status exists either.
    """
    channel = Channel(run_dir / "gateway.sock", "gateway")
    try:
        while True:
            try:
                await channel.call("report", server=server, status=msgspec.to_builtins(status()))
            except FieldtwinError:
                pass
            await clock.sleep_until_ns(clock.monotonic_ns() + REPORT_EVERY_NS)
    finally:
        await channel.aclose()
