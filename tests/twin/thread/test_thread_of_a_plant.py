"""The plant's side of a thread: which data of its process image it shares and how often, and when it may use the plant's
modem."""

from __future__ import annotations

from pathlib import Path

import pytest

from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.core.image.image import INPUTS, OUTPUTS
from fieldtwin.gateway.core.statemachine import STATE_CODES
from fieldtwin.gateway.core.values import Quality, Reason, TagValue
from fieldtwin.gateway.store.event import Event, Kind
from fieldtwin.gateway.wallclock import WallClock
from fieldtwin.run.live.options import RunOptions
from fieldtwin.run.live.session import RunSession
from fieldtwin.twin.plant.physical import gateway_config, gateway_lost_ms, image_layout
from fieldtwin.twin.site.system import load_system
from fieldtwin.twin.thread.place import delegated_transmitter, twin_carrier
from fieldtwin.twin.thread.plant_thread import REFRESH_MS, ImageProcess

PROFILES = Path(__file__).resolve().parents[3] / "profiles" / "systems"
OBSERVATORY = load_system(str(PROFILES / "observatory.yaml"))
MS = 1_000_000


class Hands:
    """A clock that the test sets."""

    now_ms = 1_790_000_000_000

    def monotonic_ns(self) -> int:
        return self.now_ms * MS

    utc_ns = monotonic_ns

    async def sleep_until_ns(self, deadline_ns: int) -> None:
        raise AssertionError("nobody waits here")


class Watched:
    """The observatory's image, and the data shared by a process that watches it."""

    def __init__(self, every_ms: int = 0) -> None:
        layout = image_layout(OBSERVATORY)
        memory = memoryview(bytearray(layout.size))
        layout.format(memory)
        image = layout.attach(memory)
        self.clock = Hands()
        self._process = ImageProcess(OBSERVATORY, layout, self.clock, every_ms)
        self._inputs, self._readers = image.writer(INPUTS), (image.reader(INPUTS), image.reader(OUTPUTS))
        index = self._readers[0].snapshot().shape.index
        self._names = sorted(index, key=index.__getitem__)

    def look(self, pressure: float | None, after_ms: int, message: bytes = b"") -> list[Event]:
        """Return the shared pressure and messages, so long after the last poll, with this pressure."""
        self.clock.now_ms += after_ms
        quality, reason = (Quality.GOOD, Reason.NONE) if pressure is not None else (Quality.BAD, Reason.TIMEOUT)
        values = {"ctd.pressure": TagValue(pressure, quality, reason, t_ns=self.clock.monotonic_ns())}
        row = [values.get(name, TagValue(0, Quality.GOOD)) for name in self._names]
        messages = {"ctd.sample": [(self.clock.monotonic_ns(), message)]} if message else {}
        self._inputs.publish(row, self.clock.monotonic_ns(), messages)
        return self.watch(0)

    def watch(self, after_ms: int) -> list[Event]:
        """Return the shared data so long after the last poll, without a new publication."""
        self.clock.now_ms += after_ms
        self._process.look(*(reader.snapshot() for reader in self._readers))
        shared = self._process.collect()
        assert {e.name for e in shared} <= {"relay"} | {
            f"{d.name}.{t}" for d in OBSERVATORY.devices.values() for t in [*d.profile.tags, "sample", "inbox"]
        }, "tags of devices, and messages; nothing of how far these were taken"
        return [e for e in shared if e.name in ("ctd.pressure", "ctd.sample")]


def test_every_change_is_shared_and_constant_values_every_ten_seconds() -> None:
    watched = Watched()
    assert [e.value for e in watched.look(1.0, 0)] == [1.0]
    assert [e.value for e in watched.look(2.0, 50)] == [2.0]
    assert watched.look(2.0, 50) == []
    assert [e.value for e in watched.look(2.0, REFRESH_MS)] == [2.0]


def test_a_thinned_thread_has_a_value_a_second_and_important_events_at_once() -> None:
    watched = Watched(every_ms=1000)
    assert [e.value for e in watched.look(1.0, 0)] == [1.0]
    assert watched.look(2.0, 500) == []
    assert [e.value for e in watched.look(3.0, 500)] == [3.0], "the newest; those between are left out"
    (bad,) = watched.look(None, 10)
    assert (bad.value, bad.reason) == (None, int(Reason.TIMEOUT))
    assert [e.value for e in watched.look(3.0, 10)] == [3.0], "it is good again"
    (message,) = watched.look(3.0, 10, b"sample")
    assert (message.kind, message.value) == (Kind.PAYLOAD, b"sample")


def test_a_state_is_reported_when_it_changes_and_again_after_a_refusal() -> None:
    """A twin's model is ahead of the plant with every command that it sends; a refusal takes it back."""
    layout = image_layout(OBSERVATORY)
    memory = memoryview(bytearray(layout.size))
    layout.format(memory)
    image, clock = layout.attach(memory), Hands()
    process = ImageProcess(OBSERVATORY, layout, clock)
    writer, readers = image.writer(OUTPUTS), (image.reader(INPUTS), image.reader(OUTPUTS))
    names = readers[1].snapshot().shape.index
    row = {n: TagValue(STATE_CODES["ACTIVE"] if n == "relay.state" else 2, Quality.GOOD) for n in names}
    writer.publish([row[n] for n in sorted(names, key=names.__getitem__)], clock.monotonic_ns(), {})

    def states() -> list[Event]:
        clock.now_ms += 50
        process.look(*(reader.snapshot() for reader in readers))
        return [e for e in process.collect() if e.kind == Kind.STATE]

    assert [len(states()) for _ in range(3)] == [1, 0, 0]
    process.share_again()
    assert [len(states()) for _ in range(2)] == [1, 0]


def test_the_last_values_of_a_dead_gateway_are_not_reported_as_good() -> None:
    """It may be dead for any time: the image still holds its publications."""
    watched = Watched()
    (told,) = watched.look(1.0, 0)
    assert told.quality == Quality.GOOD
    assert watched.watch(gateway_lost_ms(OBSERVATORY)) == []
    (told,) = watched.watch(1)
    assert (told.value, told.quality, told.reason) == (1.0, Quality.BAD, Reason.GATEWAY_DEAD)
    (told,) = watched.look(1.0, 50)
    assert told.quality == Quality.GOOD, "it is back"


def test_a_system_with_one_transmitter_lends_that() -> None:
    assert delegated_transmitter("modem:", OBSERVATORY) == delegated_transmitter("modem:modem", OBSERVATORY) == "modem"
    assert delegated_transmitter("tcp://127.0.0.1:7700", OBSERVATORY) == delegated_transmitter("", OBSERVATORY) == ""
    with pytest.raises(UsageError, match="'ctd' is not a transmitter of observatory"):
        delegated_transmitter("modem:ctd", OBSERVATORY)
    with pytest.raises(UsageError, match="a system with a transmitter"):
        delegated_transmitter("modem:", load_system(str(PROFILES / "lab_vehicle.yaml")))
    for wrong in ("modem:", "modem:modem", "modem:modem@udp://127.0.0.1:1"):
        with pytest.raises(UsageError, match="endpoint of the topside modem is missing"):
            twin_carrier(wrong, OBSERVATORY, WallClock())
    assert twin_carrier("modem:tcp://127.0.0.1:1", OBSERVATORY, WallClock()).name == "thread over modem_thread"


def test_the_gateway_leaves_a_lent_mailbox_alone() -> None:
    config = gateway_config(OBSERVATORY, allow_writes=True, delegated=("modem",))
    assert config.delegated == {"modem"}
    assert config.devices["modem"].poll == {"status": 2000}
    assert gateway_config(OBSERVATORY, allow_writes=True).devices["modem"].poll == {"inbox": 200, "status": 2000}


def test_a_plant_assigns_its_modem_only_if_it_is_writable_and_unused() -> None:
    def delegated(*, prototype: bool, **more: object) -> str:
        return RunSession(RunOptions(str(PROFILES / "observatory.yaml"), prototype, thread="modem:", **more)).delegated  # type: ignore[arg-type]

    with pytest.raises(UsageError, match="writes into its mailbox; expected --allow-writes"):
        delegated(prototype=False)
    assert delegated(prototype=False, allow_writes=True) == "modem"
    with pytest.raises(UsageError, match="belongs to the digital twin; expected --commands none"):
        delegated(prototype=True, commands=(1, 2))
    assert delegated(prototype=True) == "modem"
