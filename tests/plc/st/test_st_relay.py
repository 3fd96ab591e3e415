"""The relay in Structured Text behaves like the one in Python: the same trace with the same seeds."""

from __future__ import annotations

import random
import shutil
from pathlib import Path

import pytest

from fieldtwin.gateway.core.image.image import Message
from fieldtwin.plc.binding import load_program
from fieldtwin.plc.program import Outbox, ScanInfo
from fieldtwin.plc.relay import Relay
from fieldtwin.run.virtual.run import VirtualOptions, VirtualRun

SYSTEMS = Path(__file__).parents[3] / "profiles/systems"
MAILBOXES = ("response", "log")


def messages(rng: random.Random, odds: tuple[int, ...], longest: int) -> tuple[Message, ...]:
    return tuple(Message(n + 1, 0, rng.randbytes(rng.randint(0, longest))) for n in range(rng.choice(odds)))


@pytest.mark.parametrize("seed", range(8))
def test_same_seed_same_trace(seed: int) -> None:
    python, text = Relay(), load_program("relay.st", [str(SYSTEMS)])
    assert text.variables.keys() == python.variables.keys()
    rng = random.Random(seed)
    for number in range(1, 400):
        commands = messages(rng, (0, 0, 0, 1, 2), 3) + ((Message(9, 0, b"\0\5"),) if rng.random() < 0.1 else ())
        samples = messages(rng, (0, 0, 1, 5, 40), 256)
        taken = {"response": rng.choice([0, 3, 16]), "log": rng.choice([0, 60, 64])}
        for program in (python, text):
            program.command, program.sample = commands, samples  # type: ignore[attr-defined]
            for name in MAILBOXES:
                box: Outbox = getattr(program, name)
                box.outstanding, box.pending = taken[name], []
            program.response.max_bytes = 200  # type: ignore[attr-defined]
            program.execute(ScanInfo(number * 10_000_000, number, number == 1))
        for name in python.variables:
            ours, theirs = getattr(text, name), getattr(python, name)
            if name in MAILBOXES:
                ours, theirs = (ours.pending, ours.waits), (theirs.pending, theirs.waits)
            assert ours == theirs, (number, name)
    assert python.logged > 1000  # so that the log wrapped, and entries were lost
    assert python.dropped > 100
    assert python.bad_commands > 10


def hash_of(source: str, folder: Path, seed: int) -> tuple[str, int, list[str]]:
    """Run the observatory in virtual time with this relay; return the hash of all frames, values and states, their number, and
    the states."""
    folder.mkdir()
    for file in SYSTEMS.glob("observatory*.yaml"):
        text = file.read_text(encoding="utf-8")
        (folder / file.name).write_text(text.replace('"python: fieldtwin.plc.relay:Relay"', source), encoding="utf-8")
    shutil.copy(SYSTEMS / "relay.st", folder)
    run = VirtualRun(VirtualOptions(str(folder / "observatory.yaml"), 12.0, seed=seed, commands=(1, -1)))
    run.run()
    assert run.errors == []
    return run.trace.hexdigest(), run.trace.count, run.checks[""].states.sequence("relay")


def test_the_observatory_gives_the_same_trace(tmp_path: Path) -> None:
    python = hash_of('"python: fieldtwin.plc.relay:Relay"', tmp_path / "python", 7)
    text = hash_of("relay.st", tmp_path / "text", 7)
    assert text == python
    assert python[1:] == (python[1], ["STANDBY", "ACTIVE", "OFF"])
    assert python[1] > 500
