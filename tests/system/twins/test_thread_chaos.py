"""A digital twin and a prototype as processes, over each carrier: a link loses 20 % of the frames, and repeats and reorders
others; either side is killed at random instants. At the end the two logs are equal, row by row.

tests/twin/thread/test_thread_core.py and test_thread_carriers.py test the same in virtual time, with many seeds and in
milliseconds.
"""

from __future__ import annotations

import random
import re
import shutil
import socket
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path

import pytest
from local_mosquitto import broker
from procs import CHECKOUT, Fieldtwin, fieldtwin, free_port, no_tracebacks, wait_for
from stores import ask, log_of, own

pytestmark = [pytest.mark.long, pytest.mark.interop, pytest.mark.timeout(240)]

FAULTS = """faults:
  - {name: drop, direction: both, probability: 0.2}
  - {name: duplicate, direction: both, probability: 0.1}
  - {name: reorder, direction: both, probability: 0.1}
"""


class Chaos:
    """A plant and its twin, started and killed as often as the seed determines; their stores remain."""

    def __init__(self, folder: Path, seed: int, plant: tuple[str, ...], twin_at: str) -> None:
        self.root = folder / "r"
        shutil.copytree(CHECKOUT / "profiles", folder / "profiles", dirs_exist_ok=True)
        system = folder / "profiles" / "systems" / "observatory.yaml"
        system.write_text(system.read_text() + "commands: {period_s: [-1, 60], per_minute: 600}\n")
        self._plant = ("run", str(system), "--prototype", "--commands", "none", *plant)
        self._twin = ("twin", str(system), "--from", twin_at, "--json")
        self._chance = random.Random(seed)
        self._numbers = iter(range(1, 100))
        self.stores = (
            self.root / "observatory" / "knowledge.sqlite",
            self.root / "observatory-twin" / "knowledge.sqlite",
        )
        self.commanded: list[int] = []
        self.wanted = 0
        """Number of the plant's events when the kills ended."""

    @contextmanager
    def plant(self) -> Iterator[Fieldtwin]:
        with fieldtwin(self.root, *self._plant, name=f"plant{next(self._numbers)}") as run:
            run.control("observatory", "thread")
            yield run

    @contextmanager
    def twin(self, *options: str) -> Iterator[Fieldtwin]:
        with fieldtwin(self.root, *self._twin, *options, name=f"twin{next(self._numbers)}") as run:
            yield run

    def field_is_gone(self) -> bool:
        """The ports are free again; a prototype file may name them."""
        with closing(socket.socket(socket.AF_UNIX)) as probe:
            return probe.connect_ex(str(self.root / "observatory" / "field.sock")) != 0

    def counts(self) -> tuple[int, int]:
        """Return the number of events in the plant's log, and how many of them its twin has without a gap."""
        origin = own(self.stores[0], "plant")
        arrived = log_of(self.stores[1], origin)
        whole = next((n for n, row in enumerate(arrived) if row[0] != n + 1), len(arrived))
        return len(log_of(self.stores[0], origin)), whole

    def run(self) -> None:
        """Both sides die at some instant while events are in transit, the twin twice, and the last ones run to the end."""
        with ExitStack() as stack:
            plant = stack.enter_context(self.plant())
            for which in ("twin", "plant", "twin"):
                self.commanded.append(len(self.commanded) + 1)
                with self.twin("--command", str(self.commanded[-1])) as twin:
                    self.until_more(self._chance.randrange(5, 40), twin)
                    if which == "plant":
                        plant.process.kill()
                        plant.wait()
                        wait_for(self.field_is_gone, 10, "the field simulator, which lingers, ends")
                        plant = stack.enter_context(self.plant())
                        self.until_more(self._chance.randrange(5, 40), twin)
                    twin.process.kill()
            with self.twin("--command", "7") as twin:
                self.commanded.append(7)
                self.until_equal(plant)
                twin.signal(2)
                assert twin.wait(20) in (0, 1), twin.err
            plant.signal(2)
            plant.wait(20)

    def until_more(self, count: int, twin: Fieldtwin) -> None:
        """Wait until so many more events have arrived, and the twin has recorded its command; a twin that dies before never
        gave it."""
        began = self.counts()[1]

        def arrived() -> bool:
            assert twin.process.poll() is None, f"the twin ended by itself: {twin.err}"
            return self.counts()[1] >= began + count

        wait_for(arrived, 60, f"{count} more events arrive")
        wait_for(
            lambda: len(log_of(self.stores[1], own(self.stores[1], "twin"))) == len(self.commanded), 20, "commands"
        )

    def until_equal(self, plant: Fieldtwin) -> None:
        """Wait until both sides have all events."""
        thread = plant.control("observatory", "thread")
        wait_for(lambda: own(self.stores[1], "twin") and self._all_commands_there(), 60, f"commands: {thread('get')}")
        self.wanted = self.counts()[0]
        wait_for(lambda: self.counts()[1] >= self.wanted, 90, f"{self.wanted} events at the twin: {thread('get')}")

    def _all_commands_there(self) -> bool:
        origin = own(self.stores[1], "twin")
        sent = log_of(self.stores[1], origin)
        return len(sent) >= len(self.commanded) and sent == log_of(self.stores[0], origin)

    def judge(self) -> None:
        here, there = self.stores
        plants, twins = own(here, "plant"), own(there, "twin")
        sent, arrived = log_of(here, plants), log_of(there, plants)
        assert arrived[: self.wanted] == sent[: self.wanted], "no gap, none twice, row by row"
        assert set(arrived) <= set(sent), "and what was under way at the end"
        assert self.wanted > 100
        assert log_of(there, twins) == log_of(here, twins)
        assert ask(here, "SELECT * FROM lost") == ask(there, "SELECT * FROM lost") == []
        periods = [int.from_bytes(row[5], signed=True) for row in log_of(here, twins)]
        assert periods == self.commanded, "each command once, in order"
        obeyed = [row[0] for row in sent if row[2] == 1 and row[3] == twins]
        refused = [row for row in sent if row[2] == 2]
        assert len(obeyed) + len(refused) <= len(periods), "no command is obeyed twice"
        no_tracebacks(self.root)


@contextmanager
def shaken(folder: Path, framing: str, target: int) -> Iterator[int]:
    """The port of a link to `target` that loses, repeats and reorders."""
    (folder / "faults.yaml").write_text(FAULTS)
    port = free_port()
    ends = f"tcp://127.0.0.1:{port}?listen=1", f"tcp://127.0.0.1:{target}"
    with fieldtwin(
        folder / "l", "link", "--framing", framing, "--faults", str(folder / "faults.yaml"), *ends, name="link"
    ) as link:
        wait_for(lambda: "⇄" in link.err, 20, link.err)
        yield port


def test_a_digital_thread_over_tcp_survives_kills_and_losses(tmp_path: Path) -> None:
    port = free_port()
    with shaken(tmp_path, "thread", port) as far:
        chaos = Chaos(tmp_path, 1, ("--thread", f"tcp://127.0.0.1:{port}"), f"tcp://127.0.0.1:{far}")
        chaos.run()
    chaos.judge()


def test_a_digital_thread_over_mqtt_survives_kills_and_losses(tmp_path: Path) -> None:
    with broker(tmp_path) as here, shaken(tmp_path, "mqtt", here.port) as far:
        chaos = Chaos(
            tmp_path, 2, ("--thread", f"mqtt://127.0.0.1:{here.port}/sea/obs"), f"mqtt://127.0.0.1:{far}/sea/obs"
        )
        chaos.run()
    chaos.judge()


def test_over_the_modems(tmp_path: Path) -> None:
    """The modems of the reference system, 64 bytes per message. They do not repeat lost messages, and die with the plant."""
    port = free_port()
    chaos = Chaos(tmp_path, 3, ("--thread", "modem:"), f"modem:tcp://127.0.0.1:{port}")
    prototype = tmp_path / "profiles" / "systems" / "observatory.prototype.yaml"
    link = "{bytes_per_s: 2000, latency_ms: 100, lost: 0.2, repeated: 0.1, overtakes: 0.1}"
    text, count = re.subn(
        r'far: "tcp://127.0.0.1:0", far_link: \{.*?\}',
        f'far: "tcp://127.0.0.1:{port}", far_link: {link}',
        prototype.read_text(),
    )
    assert count == 1
    prototype.write_text(text)
    chaos.run()
    chaos.judge()
