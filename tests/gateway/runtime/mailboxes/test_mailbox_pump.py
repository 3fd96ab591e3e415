"""A transmitter's mailboxes, the gateway's side and the remote end's, in virtual time."""

from __future__ import annotations

import asyncio
from pathlib import Path

from fieldtwin.emulators.virtual.loop import VirtualLoop
from fieldtwin.gateway.core.clock import NS_PER_MS
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.values import COMMAND
from fieldtwin.gateway.runtime.mailboxes.mailboxes import Patience
from fieldtwin.run.processes.topside import TopsideController
from fieldtwin.twin.prototype.file import load_prototype
from fieldtwin.twin.prototype.virtual import VirtualPrototype
from fieldtwin.twin.site.system import load_system

MESSAGES = 12


def test_a_slow_modem_is_not_asked_all_the_time(tmp_path: Path) -> None:
    """A message stays in the outbox until the link has room. Once that duration is known, one or two polls per message are
    sufficient, and the link is as busy as before."""
    loop = VirtualLoop()

    async def main() -> None:
        system = load_system("observatory")
        async with VirtualPrototype(system, load_prototype(system), loop, tmp_path) as run, Nursery() as nursery:
            topside = TopsideController(system, "modem", run.field.far["modem"], run.clock, run.net)
            nursery.start(topside.run([]), "topside")
            await asyncio.sleep(3.0)
            pump = run.gateway.pumps[0]
            pump.offer([bytes(64)] * 30)  # more than the modem and its link accept at once
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


def test_the_mailbox_of_the_remote_end_is_not_checked_too_often_either(tmp_path: Path) -> None:
    loop = VirtualLoop()

    async def main() -> None:
        system = load_system("observatory")
        async with VirtualPrototype(system, load_prototype(system), loop, tmp_path) as run, Nursery() as nursery:
            topside = TopsideController(system, "modem", run.field.far["modem"], run.clock, run.net)
            nursery.start(topside.run([]), "topside")
            await asyncio.sleep(3.0)
            far = topside._driver
            for _ in range(80):
                far.consumer.observe(COMMAND(bytes(64)))
            while (
                len(far.consumer.queue) > MESSAGES
            ):  # more than the modems, their link and the plant's inbox accept at once
                await asyncio.sleep(0.05)
            looks, sent = far.mailbox_waits, far.sent
            while far.consumer.queue:
                await asyncio.sleep(0.05)
            assert far.sent - sent == MESSAGES
            assert (far.mailbox_waits - looks) / MESSAGES < 1, "asked every 50 ms it would be two"

    loop.run_until_complete(main())
    loop.close()


def looks(patience: Patience, begin_ms: int, free_ms: int) -> list[int]:
    """Return the times of polls of the outbox, each 20 ms from `begin_ms` on, until it is free."""
    found = []
    for now_ms in range(begin_ms, begin_ms + 100_000, 20):
        if patience.asks(now_ms * NS_PER_MS):
            found.append(now_ms)
            if now_ms >= free_ms:
                return found
            patience.full()
    raise AssertionError("nobody looks any more")


def test_patience_grows_with_the_modem_and_shrinks_with_it() -> None:
    patience = Patience()
    patience.sent(0)
    first = looks(patience, 0, 1000)
    assert first == list(range(0, 1021, 60))  # without knowledge: every 50 ms, at a tick
    patience.sent(1020 * NS_PER_MS)
    assert looks(patience, 1040, 2020)[0] == 1020 + 780  # three quarters of 1020 ms, at a tick
    patience.sent(2040 * NS_PER_MS)
    assert looks(patience, 2060, 2060) == [2820]  # it was free long before; no poll saw it
    patience.sent(2820 * NS_PER_MS)
    assert looks(patience, 2840, 2840) == [3420]
    patience.sent(3420 * NS_PER_MS)
    assert looks(patience, 3440, 99_000)[-1] <= 99_060
    patience.sent(99_060 * NS_PER_MS)
    assert looks(patience, 99_080, 99_080) == [101_060]  # no longer than two seconds


def test_an_occasional_message_gives_no_information_on_the_modems_speed() -> None:
    patience = Patience()
    for at_ms in range(0, 60_000, 10_000):
        patience.sent(at_ms * NS_PER_MS)
        assert looks(patience, at_ms + 5000, at_ms) == [at_ms + 5000]
    patience.sent(60_000 * NS_PER_MS)
    assert patience.asks(60_020 * NS_PER_MS), "the next one need not wait for that"
