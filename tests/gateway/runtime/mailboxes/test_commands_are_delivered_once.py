"""A gateway that dies between taking a command and acknowledging it: its successor acknowledges, and passes nothing on twice."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest
from gateway_rig import LAN, PROFILES, FieldBus, running_bus
from support import eventually, run

from fieldtwin.emulators.modbus.unit import ModbusUnit
from fieldtwin.emulators.models.modbus.mailbox_modem import ModemPair
from fieldtwin.gateway.core.errors import Unreachable
from fieldtwin.gateway.core.files.profile_file import load_profile
from fieldtwin.gateway.core.values import COMMAND, RESPONSE
from fieldtwin.gateway.devices.config import DeviceConfig
from fieldtwin.gateway.devices.transmitter import TransmitterDriver
from fieldtwin.gateway.runtime.audit_log import AuditLog
from fieldtwin.gateway.runtime.buses.modbus.jobs import BusJob
from fieldtwin.gateway.runtime.mailboxes.acked_commands import AckedCommandStore
from fieldtwin.gateway.runtime.mailboxes.pump import MailboxPump
from fieldtwin.gateway.runtime.tags import TagTable
from fieldtwin.gateway.wallclock import WallClock

PROFILE = load_profile(PROFILES / "modem-mailbox.yaml")
POLL = {"inbox": 20}


class Life:
    """One life of a gateway's side of a modem. `taken`: the messages that the control logic received and consumed."""

    def __init__(self, pump: MailboxPump, field: FieldBus) -> None:
        self.pump = pump
        self.field = field
        self.taken: list[bytes] = []

    def consume(self) -> None:
        self.taken += [item.data for item in self.pump.inbox.drain()]

    async def offered(self) -> None:
        """A message for the control logic arrived."""
        await eventually(lambda: bool(self.pump.inbox.queue))

    async def acknowledged(self) -> None:
        def all_is() -> bool:
            self.tick()
            return not self.pump.driver.to_acknowledge

        await eventually(all_is)
        self.tick()

    def tick(self, consumed: bool = True) -> None:
        self.pump.tick(WallClock().monotonic_ns(), consumed)


@asynccontextmanager
async def life(
    modems: ModemPair, folder: Path, *, writes: bool, file: AckedCommandStore | None = None
) -> AsyncIterator[Life]:
    """`writes` False: it dies before it acknowledges anything."""
    drivers: list[TransmitterDriver] = []

    def make(tags: TagTable) -> list[TransmitterDriver]:
        drivers.append(TransmitterDriver(DeviceConfig("modem", PROFILE, "bus", 1, poll=POLL), tags))
        return drivers

    clock = WallClock()
    audit = AuditLog(folder / "audit.jsonl", clock)
    try:
        async with running_bus(make, FieldBus({1: ModbusUnit(modems.near)}), LAN) as r:  # type: ignore[arg-type]
            kept = file or AckedCommandStore(folder / "taken.json")
            made = Life(MailboxPump(drivers[0], r.bus, audit, allow_writes=writes, remote=True, taken=kept), r.field)
            await eventually(lambda: r.bus.online(drivers[0]))
            yield made
    finally:
        audit.close()


async def command(modems: ModemPair, payload: bytes) -> None:
    """The remote client sends it."""
    drivers: list[TransmitterDriver] = []

    def make(tags: TagTable) -> list[TransmitterDriver]:
        drivers.append(TransmitterDriver(DeviceConfig("far", PROFILE, "bus", 1), tags, incoming=RESPONSE))
        return drivers

    async with running_bus(make, FieldBus({1: ModbusUnit(modems.far)}), LAN) as r:  # type: ignore[arg-type]
        await eventually(lambda: r.bus.online(drivers[0]))
        drivers[0].consumer.observe(COMMAND(payload))
        done: list[object] = []
        r.bus.submit(BusJob(drivers[0], drivers[0].send, done.append))
        await eventually(lambda: done == [None])


def modem_pair() -> ModemPair:
    return ModemPair(PROFILE, bytes_per_s=1e6, latency_s=0.0, loss=0.0, seed=1)


@pytest.mark.parametrize("kept", [True, False])
def test_a_command_that_was_consumed_is_not_handed_on_again(tmp_path: Path, kept: bool) -> None:
    async def main() -> None:
        modems = modem_pair()
        await command(modems, b"\0\7")
        async with life(modems, tmp_path, writes=False) as first:
            await first.offered()
            first.consume()
            first.tick()
            assert first.taken == [b"\0\7"]
        if not kept:
            (tmp_path / "taken.json").unlink()
        async with life(modems, tmp_path, writes=True) as second:
            if not kept:  # without it, at-least-once is the only guarantee
                await second.offered()
                second.consume()
                assert second.taken == [b"\0\7"]
            await second.acknowledged()
            second.consume()
            assert second.taken == ([] if kept else [b"\0\7"])
            await command(modems, b"\0\7")  # the same bytes again are a new message
            await second.offered()
        assert AckedCommandStore(tmp_path / "taken.json").of("modem") == b"", "what is acknowledged is forgotten"

    run(main())


def test_an_unconsumed_command_is_passed_on(tmp_path: Path) -> None:
    async def main() -> None:
        modems = modem_pair()
        await command(modems, b"\0\7")
        async with life(modems, tmp_path, writes=True) as first:
            await first.offered()
            first.tick()
            first.consume()
            first.tick(consumed=False)  # it is in the process image, and no program has read it yet
            await asyncio.sleep(0)
        async with life(modems, tmp_path, writes=True) as second:
            await second.offered()

    run(main())


def test_commands_taken_from_a_restarted_modem_do_not_count(tmp_path: Path) -> None:
    """Its first message has the number and the content of the first one before: it is a new command."""

    async def main() -> None:
        before, after = modem_pair(), modem_pair()
        await command(before, b"\0\7")
        async with life(before, tmp_path, writes=False) as first:
            await first.offered()
            first.consume()
            first.tick()
        assert AckedCommandStore(tmp_path / "taken.json").of("modem")
        async with life(after, tmp_path, writes=True) as second:
            second.tick()
            second.field.unplug()  # it comes while no gateway polls
            await command(after, b"\0\7")
            second.field.plugged = True
            await second.offered()

    run(main())


@pytest.mark.parametrize("text", ["", "[]", '{"modem": 3}', '{"modem": "xy"}', "\x00"])
def test_a_foreign_file_counts_as_missing(tmp_path: Path, text: str) -> None:
    (tmp_path / "taken.json").write_text(text)
    file = AckedCommandStore(tmp_path / "taken.json")
    assert file.of("modem") == b""
    file.note("modem", b"\1\2")
    assert AckedCommandStore(tmp_path / "taken.json").of("modem") == b"\1\2"
    assert (tmp_path / "taken.json").stat().st_mode & 0o777 == 0o600


def test_a_disk_that_refuses_is_reported(tmp_path: Path) -> None:
    file = AckedCommandStore(tmp_path / "nowhere" / "taken.json")
    with pytest.raises(Unreachable, match="cannot store the executed commands"):
        file.note("modem", b"\1")
