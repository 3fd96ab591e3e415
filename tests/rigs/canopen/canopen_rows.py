"""The rows of tests/vectors/canopen_slave.toml: inputs with their times, and expected outputs."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from canopen_slave_rig import NODE, RICH

from fieldtwin.emulators.canopen.aborts import Abort
from fieldtwin.emulators.canopen.eds.dictionary import parse_eds
from fieldtwin.emulators.canopen.lss.slave import LssStore
from fieldtwin.emulators.canopen.node import CanopenNode, NodeContext
from fieldtwin.emulators.canopen.time_of_day import TimeOfDay
from fieldtwin.gateway.core.can_error import CanErrorState
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.clock import NS_PER_MS

FILE = Path(__file__).parents[2] / "vectors" / "canopen_slave.toml"


@dataclass(frozen=True)
class Row:
    """One row. Times in ms since the boot-up; `hear` contains frames and, after a ``!``, events of the device itself."""

    id: str
    hear: list[tuple[float, str]]
    say: list[tuple[float, str]]
    state: str
    until_ms: float
    node_id: int = NODE
    options: dict[str, Any] = field(default_factory=dict)
    values: dict[str, str] = field(default_factory=dict)
    counters: dict[str, int] = field(default_factory=dict)
    timed: bool = False
    """A silence in it depends on the elapsed time."""

    @property
    def answers_only(self) -> bool:
        """Return whether all replies are immediate, so that the row needs no clock."""
        return not self.timed and {at for at, _ in self.say} <= {at for at, _ in self.hear}

    def make(self) -> CanopenNode:
        """Return the node of the row, without power."""
        options = dict(self.options)
        if "lss_store" in options:
            options["lss_store"] = LssStore[options["lss_store"]]
        if "refusals" in options:
            options["refusals"] = {key_of(key): Abort[code] for key, code in options["refusals"].items()}
        return CanopenNode(parse_eds(RICH), self.node_id, NodeContext(**options))

    def check_end(self, node: CanopenNode) -> None:
        """Return the state after the row."""
        assert node.state.name.replace("_", "-") == self.state
        assert {key: node.data.get(*key_of(key)).hex() for key in self.values} == self.values
        counted = node.counters.as_dict()
        assert {name: counted[name] for name in self.counters} == self.counters


def load() -> list[Row]:
    """Return all rows, in the file's order."""
    rows = []
    for entry in tomllib.loads(FILE.read_text())["row"]:
        hear = [(float(at), what) for at, what in entry.pop("hear")]
        say = [(float(at), what) for at, what in entry.pop("say")]
        until = entry.pop("until_ms", max([at for at, _ in hear] + [at for at, _ in say]))
        rows.append(Row(hear=hear, say=say, until_ms=float(until), **entry))
    return rows


def key_of(text: str) -> tuple[int, int]:
    """Parse ``2006:00`` as index and subindex."""
    index, _, subindex = text.partition(":")
    return int(index, 16), int(subindex, 16)


def parse_frame(text: str) -> CanFrame:
    """Parse a frame in candump's notation; blanks between bytes are allowed. Eight digits of identifier make it extended."""
    identifier, _, body = text.partition("#")
    extended = len(identifier) > 3
    if body.startswith("R"):
        return CanFrame(int(identifier, 16), extended=extended, remote=True, dlc=int(body[1:] or "0"))
    return CanFrame(int(identifier, 16), bytes.fromhex(body), extended=extended)


def happen(node: CanopenNode, event: str, now_ns: int) -> list[CanFrame]:
    """Apply an event of the device: ``!bus-off``, ``!error 5000``, ``!set 2002:00 3412``..."""
    name, *words = event.removeprefix("!").split()
    if name in (state.value for state in CanErrorState):
        return node.bus_state(CanErrorState(name), now_ns)
    if name == "overrun":
        return node.overrun(now_ns)
    if name == "error":
        return node.raise_error(int(words[0], 16), now_ns, register=int(words[1], 16) if len(words) > 1 else 1)
    if name == "clear":
        return node.clear_error(int(words[0], 16), now_ns)
    if name == "set":
        return node.set_value(*key_of(words[0]), bytes.fromhex(words[1]), now_ns)
    if name == "time":
        return node.set_time(TimeOfDay(int(words[0]), int(words[1])), now_ns)
    if name == "power":
        return node.start(now_ns)
    raise AssertionError(f"no such event: {event}")


def play(row: Row, node: CanopenNode) -> list[tuple[float, str]]:
    """Run the row on the pure node; return its frames with their times."""
    now_ns = start_ns = 1_000_000_000
    said: list[tuple[float, str]] = []

    def took(frames: list[CanFrame]) -> None:
        said.extend(((now_ns - start_ns) / NS_PER_MS, str(frame)) for frame in frames)

    node.start(now_ns)
    for at_ms, what in [*row.hear, (row.until_ms, "")]:
        at_ns = start_ns + round(at_ms * NS_PER_MS)
        for _ in range(10_000):
            wake_ns = node.wake_at_ns()
            if wake_ns is None or wake_ns > at_ns:
                break
            now_ns = max(now_ns, wake_ns)
            took(node.tick(now_ns))
        else:
            raise AssertionError("the node asks to be woken without end")
        now_ns = at_ns
        if what:
            took(happen(node, what, now_ns) if what.startswith("!") else node.feed(parse_frame(what), now_ns))
    return said
