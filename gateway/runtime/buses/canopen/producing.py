"""The SYNC and TIME messages that the gateway sends on a CAN bus, each at its time."""

from __future__ import annotations

import asyncio

from fieldtwin.gateway.core.clock import NS_PER_S, Clock
from fieldtwin.gateway.devices.canopen_config import CanopenBusConfig
from fieldtwin.gateway.protocols.canopen.master import CanopenMaster
from fieldtwin.gateway.protocols.canopen.pdo.sync import FrameProducer, SyncProducer, TimeProducer


class Producing:
    """The sending of SYNC and TIME on one bus. `not_produced` counts the messages that were not sent in time."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self.not_produced = 0

    def producers(self, config: CanopenBusConfig) -> list[FrameProducer]:
        """Return the SYNC and TIME producers that `config` states."""
        now_ns = self._clock.monotonic_ns()
        made: list[FrameProducer] = []
        if config.sync_ms:
            made.append(SyncProducer(config.sync_ms * 1000, now_ns, overflow=config.sync_counter))
        if config.time_ms:
            made.append(TimeProducer(config.time_ms, now_ns))
        return made

    async def run(self, producer: FrameProducer, master: CanopenMaster) -> None:
        """Send each message when it is due. A message that the bus does not take within one period is dropped and
        counted."""
        while True:
            await self._clock.sleep_until_ns(producer.next_ns)
            missed = producer.missed
            frame = producer.due(self._clock.monotonic_ns(), self._clock.utc_ns())
            self.not_produced += producer.missed - missed
            if frame is not None:
                try:
                    async with asyncio.timeout(producer.period_ns / NS_PER_S):
                        await master.send(frame)
                except TimeoutError:
                    self.not_produced += 1
