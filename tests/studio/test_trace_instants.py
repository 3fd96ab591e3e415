"""The state that Studio shows of an instant is the state that the gateway and the PLC of the run had then."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from fieldtwin.results.trace_about import read_about, write_about
from fieldtwin.run.virtual.run import VirtualOptions, VirtualRun
from fieldtwin.studio.replay.instant import state_at
from fieldtwin.studio.replay.marks import marks_of
from fieldtwin.studio.replay.replay import Replay

SECONDS = 25.0
EVERY_NS = 370_000_000
FAULTS = (
    {"id": "quiet", "name": "silence", "device": "ctd", "from": 12.0, "until": 15.0},
    {"id": "deaf", "name": "heartbeat-loss", "device": "inclinometer", "from": 16.0, "until": 18.0},
)

NEVER, NO_NUMBER = ("bad", "never_read"), ("bad", "not_a_number")
"""The gateway reports no second reason of a value that was never good, so the trace keeps the first reason."""


class Sampled(VirtualRun):
    """A run that notes the gateway's values at regular instants."""

    def __init__(self, options: VirtualOptions) -> None:
        super().__init__(options)
        self.seen: dict[int, dict[str, tuple[Any, str, str]]] = {}

    def attach(self, running: Any) -> None:
        super().attach(running)
        [bench] = running.systems.values()

        async def sample() -> None:
            t_ns = EVERY_NS
            while True:
                await bench.run.clock.sleep_until_ns(bench.run.started_ns + t_ns + 1)  # after the events of t_ns
                tags = {}
                for name in bench.run.gateway.tags.names:
                    now = bench.run.gateway.tags.current(name, bench.run.started_ns + t_ns)
                    value = now.value.hex() if isinstance(now.value, bytes) else now.value
                    tags[name] = value, now.quality.name.lower(), now.reason.name.lower()
                self.seen[t_ns] = tags
                t_ns += EVERY_NS

        self._sampling = asyncio.ensure_future(sample())


@pytest.fixture(scope="module")
def sampled(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Sampled]:
    trace = tmp_path_factory.mktemp("run") / "run.jsonl"
    run = Sampled(VirtualOptions("observatory", SECONDS, seed=3, commands=(2, 1), faults=FAULTS, trace=trace))
    run.run()
    assert run.errors == []
    return trace, run


@contextmanager
def opened(trace: Path) -> Iterator[Replay]:
    """Return a trace that is indexed to its end."""
    replay = Replay(trace.name, trace)
    while replay.log.follow():
        pass
    while replay.frames.follow():
        pass
    try:
        yield replay
    finally:
        replay.log.close()
        replay.frames.close()


def test_every_value_of_a_run_is_shown_with_the_quality_that_the_gateway_gave_to_it(
    sampled: tuple[Path, Sampled],
) -> None:
    trace, run = sampled
    assert len(run.seen) > 50
    qualities = set()
    with opened(trace) as replay:
        for t_ns, tags in run.seen.items():
            shown = state_at(replay, t_ns)["gateway"]["tags"]
            found = {name: (shown[name]["value"], shown[name]["quality"], shown[name]["reason"]) for name in tags}
            expected = {name: (None, *NEVER) if tag[1:] == NO_NUMBER else tag for name, tag in tags.items()}
            assert found == expected, f"at {t_ns / 1e9} s"
            qualities |= {(quality, reason) for _, quality, reason in tags.values()}
    assert {("good", "none"), ("bad", "timeout")} <= qualities


def cut_off(trace: Path, folder: Path) -> Path:
    """Return a copy of a trace with the events of 11 s and a note after 20 s."""
    lines = trace.read_bytes().splitlines(keepends=True)
    before = [line for line in lines if json.loads(line)[0] < 11_000_000_000]
    cut = folder / "run.jsonl"
    cut.write_bytes(b"".join(before) + b'[20000000000,"note","test",{"text":"nothing more was read"}]\n')
    about = read_about(trace)
    assert about is not None
    write_about(cut, about)
    return cut


def test_a_value_that_is_not_read_again_is_stale_and_an_identity_is_not(
    sampled: tuple[Path, Sampled], tmp_path: Path
) -> None:
    """The gateway writes no event when a value gets too old: the frames show whether it was read again."""
    with opened(cut_off(sampled[0], tmp_path)) as replay:
        then = state_at(replay, 10_990_000_000)["gateway"]["tags"]
        assert then["ctd.pressure"]["quality"] == "good"
        later = state_at(replay, 19_000_000_000)["gateway"]["tags"]
        stale = [name for name, tag in later.items() if (tag["quality"], tag["reason"]) == ("bad", "stale")]
        assert {"ctd.pressure", "inclinometer.slope_long", "modem.link_state"} <= set(stale)
        assert later["ctd.serial"]["quality"] == "good", "an identity does not age"
        assert later["ctd.pressure"]["value"] == then["ctd.pressure"]["value"]


def test_faults_with_times_of_their_own_are_marked_and_active_from_then_on(sampled: tuple[Path, Sampled]) -> None:
    with opened(sampled[0]) as replay:
        marks, left_out = marks_of(replay.log, replay.about, ["relay"])
        faults = [(mark["t_ns"], mark["kind"], mark["text"]) for mark in marks if mark["kind"] in ("fault", "cleared")]
        assert faults == [
            (12_000_000_000, "fault", "silence on ctd"),
            (15_000_000_000, "cleared", "silence on ctd ends"),
            (16_000_000_000, "fault", "heartbeat-loss on inclinometer"),
            (18_000_000_000, "cleared", "heartbeat-loss on inclinometer ends"),
        ]
        assert left_out == 0
        active = [
            [fault["id"] for fault in state_at(replay, t)["field"]["faults"]] for t in (0, 12 * 10**9, 15 * 10**9)
        ]
        assert active == [[], ["quiet"], []]


def test_an_old_value_is_uncertain_until_the_frames_are_read(sampled: tuple[Path, Sampled], tmp_path: Path) -> None:
    replay = Replay("run.jsonl", cut_off(sampled[0], tmp_path))
    while replay.log.follow():
        pass
    tag = state_at(replay, 19_000_000_000)["gateway"]["tags"]["ctd.pressure"]
    assert (tag["quality"], tag["reason"]) == ("uncertain", "frames_not_read_yet")
    while replay.frames.follow():
        pass
    tag = state_at(replay, 19_000_000_000)["gateway"]["tags"]["ctd.pressure"]
    assert (tag["quality"], tag["reason"]) == ("bad", "stale")
    replay.log.close()
    replay.frames.close()
