"""The gateway's side of a transmitter's mailboxes, in virtual time."""

from __future__ import annotations

import asyncio
from pathlib import Path

from emulators.virtual.loop import VirtualLoop
from fieldtwin.running.shore import Shore
from gateway.core.nursery import Nursery
from twin.prototype_file import load_prototype
from twin.system import load_system
from twin.virtual import VirtualPrototype

MESSAGES = 12


def test_a_slow_modem_is_not_asked_all_the_time(tmp_path: Path) -> None:
    """A message stays in the outbox until the link has room: once it is known how long that takes, a look or two a message are
    enough, and the link is as busy as it was."""
    loop = VirtualLoop()

    async def main() -> None:
        system = load_system("observatory")
        async with VirtualPrototype(system, load_prototype(system), loop, tmp_path) as run, Nursery() as nursery:
            shore = Shore(system, "modem", run.field.far["modem"], run.clock, run.net)
            nursery.start(shore.run([]), "far end")
            await asyncio.sleep(3.0)
            pump = run.gateway.pumps[0]
            pump.offer([bytes(64)] * 30)  # more than the modem and its link take at once
            while pump.driver.consumer.queue:
                await asyncio.sleep(0.5)
            began, looks, sent = loop.time(), pump.driver.mailbox_waits, pump.driver.sent
            pump.offer([bytes(64)] * MESSAGES)
            while pump.driver.consumer.queue:
                await asyncio.sleep(0.05)
            took = (loop.time() - began) / (pump.driver.sent - sent)
            assert took < 0.35, "seconds a message, as when it is asked every 50 ms"
            assert (pump.driver.mailbox_waits - looks) / MESSAGES < 2, "asked every 50 ms it would be four"

    loop.run_until_complete(main())
    loop.close()
