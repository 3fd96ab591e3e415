"""The wire of an emulated device as a test sees it: what was asked and answered on it, in words and values; faults on it.

Standard library only: see `fieldtwin.testing.runner`.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from fieldtwin.testing.runner import Runner

POLL_S = 0.02


@dataclass(frozen=True)
class Exchange:
    """A request with its answer, or a message that has none (a heartbeat, a PDO).

    `function` is the Modbus function code, 0 on CANopen; `access` is read, write, read and write, or ""; `address` the first
    register, bit or object (index) as it is sent, `count` how many. `tags` are the values carried, in engineering units, by the
    profile's names. `exception` or `abort` is the code where it was refused. `problem` is "" where all is well, else
    ``no reply``, ``exception``, ``abort``, ``check sum``, ``stray`` or ``malformed``. `t_s` counts from when the wire came up.
    `request` and `reply` are the bytes, `text` and `reply_text` the same in words.
    """

    number: int
    t_s: float
    device: str
    unit: int
    function: int
    service: str
    access: str
    address: int | None
    count: int
    tags: dict[str, Any] = field(default_factory=dict)
    registers: tuple[int, ...] = ()
    value: Any = None
    exception: int | None = None
    abort: int | None = None
    latency_ms: float | None = None
    problem: str = ""
    text: str = ""
    reply_text: str = ""
    request: bytes = b""
    reply: bytes = b""

    def __str__(self) -> str:
        return f"{self.t_s:.3f} s  {self.text} -> {self.reply_text or self.problem or 'no answer wanted'}"


_FIELDS = set(Exchange.__dataclass_fields__)


def _exchange(plain: dict[str, Any]) -> Exchange:
    known = {key: value for key, value in plain.items() if key in _FIELDS}
    known |= {key: bytes.fromhex(plain.get(key, "")) for key in ("request", "reply")}
    return Exchange(**{**known, "registers": tuple(plain.get("registers", ()))})


class Wire:
    """All wires of a field side, or those of one `device`."""

    def __init__(self, runner: Runner, bench: int, device: str = "") -> None:
        self._runner = runner
        self._bench = bench
        self._device = device
        self._since = 0

    def exchanges(self, **like: Any) -> list[Exchange]:
        """What was exchanged since the test began, or since `clear`, the oldest first; the latest 20,000 are kept.

        `like` leaves those whose fields are equal: ``exchanges(function=16)``; ``tag="period"`` those that carry that tag.
        A request that has had no answer for 50 ms is one with the problem ``no reply``.
        """
        __tracebackhide__ = True
        found: list[Exchange] = []
        since = self._since
        while True:
            answer = self._runner.call("exchanges", id=self._bench, since=since)
            found += map(_exchange, answer["exchanges"])
            if not answer["exchanges"]:
                return [e for e in found if self._is(e, like)]
            since = found[-1].number

    def _is(self, exchange: Exchange, like: dict[str, Any]) -> bool:
        if self._device and exchange.device != self._device:
            return False
        return all(
            value in exchange.tags if key == "tag" else getattr(exchange, key) == value for key, value in like.items()
        )

    def clear(self) -> None:
        """Forget what was exchanged so far."""
        while answer := self._runner.call("exchanges", id=self._bench, since=self._since)["exchanges"]:
            self._since = answer[-1]["number"]

    def count(self, **like: Any) -> int:
        """How many `exchanges`."""
        return len(self.exchanges(**like))

    def expect(self, times: int = 1, within_s: float = 2.0, **like: Any) -> list[Exchange]:
        """Wait until there are `times` such exchanges, and return them. `AssertionError` with what there was instead, where there
        are more, or fewer after `within_s`."""
        __tracebackhide__ = True
        until = time.monotonic() + within_s
        while True:
            found = self.exchanges(**like)
            if len(found) >= times or time.monotonic() >= until:
                break
            time.sleep(POLL_S)
        if len(found) != times:
            wanted = ", ".join(f"{key}={value!r}" for key, value in like.items()) or "exchanges"
            there = "\n".join(f"  {e}" for e in self.exchanges()[-10:]) or "  nothing"
            raise AssertionError(f"{times} times {wanted} expected, {len(found)} seen; on the wire was:\n{there}")
        return found

    @contextmanager
    def fault(self, name: str, **more: Any) -> Iterator[str]:
        """The wire misbehaves while the block runs: ``with wire.fault("silence"):``; names and parameters as `fieldtwin faults`
        lists them."""
        __tracebackhide__ = True
        aim = {"device": self._device} if self._device and not {"device", "bus"} & set(more) else {}
        id = self._runner.call("fault", id=self._bench, fault={"name": name, **aim, **_keys(more)})
        try:
            yield id
        finally:
            self._runner.call("clear", id=self._bench, fault=id)


def _keys(more: dict[str, Any]) -> dict[str, Any]:
    """Keyword arguments as a fault file's keys: ``from_`` is a word of Python's."""
    return {key.removesuffix("_"): value for key, value in more.items()}
