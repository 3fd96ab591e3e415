"""The traffic of an emulated device, for tests: decoded requests and replies, and faults on its connection.

This module imports only the standard library, see `fieldtwin.testing.runner`.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from fieldtwin.gateway.core.files.nearest import did_you_mean
from fieldtwin.testing.runner import WorkerProcess

POLL_S = 0.02
SHOWN = 10
"""The number of exchanges that the error of a failed expectation shows: the last ones."""


@dataclass(frozen=True)
class Exchange:
    """A request with its answer, or a message that has none (a heartbeat, a PDO).

    `function` is the Modbus function code, 0 on CANopen; `access` is read, write, read and write, or ""; `address` is
    the first register, bit or object (index) as sent, `count` their number. `tags` are the values carried, in
    engineering units, by the profile's names. `exception` or `abort` is the code of a refusal. `problem` is "" for a
    good exchange, else ``pending``, ``no reply``, ``exception``, ``abort``, ``check sum``, ``stray`` or ``malformed``.
    `t_s` counts from the opening of the connection. `request` and `reply` are the bytes, `text` and `reply_text` their
    descriptions. `transaction` is the transaction ID on Modbus TCP.

    A request is ``pending`` until its reply comes. It has ``no reply`` once none can follow: the next request was sent
    on a serial line, a later request was answered on Modbus TCP, or the connection was closed. A ``stray`` is a frame
    that answers no request: it has a `reply` and no `request`. `number` counts completed exchanges; that of a pending
    request is 0.
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
    transaction: int | None = None

    def __str__(self) -> str:
        if self.problem == "stray":
            return f"{self.t_s:.3f} s  {self.text}"
        reply = self.reply_text or self.problem
        return f"{self.t_s:.3f} s  {self.text} -> {reply}" if reply else f"{self.t_s:.3f} s  {self.text}"


_FIELDS = set(Exchange.__dataclass_fields__)
PROBLEMS = ("", "pending", "no reply", "exception", "abort", "check sum", "stray", "malformed")
ACCESSES = ("", "read", "write", "read and write")


def _exchange(plain: dict[str, Any]) -> Exchange:
    known = {key: value for key, value in plain.items() if key in _FIELDS}
    known |= {key: bytes.fromhex(plain.get(key, "")) for key in ("request", "reply")}
    return Exchange(**{**known, "registers": tuple(plain.get("registers", ()))})


class RecordedTraffic:
    """The traffic of all buses of a field simulator, or that of one `device`."""

    def __init__(self, runner: WorkerProcess, bench: int, device: str = "") -> None:
        self._runner = runner
        self._bench = bench
        self._device = device
        self._since = 0
        self._after_s = 0.0

    def exchanges(self, *, strays: bool = False, **like: Any) -> list[Exchange]:
        """Return the exchanges since the test began, or since `clear`, by the time of the request.

        The latest 20,000 are kept. A request that waits for its reply has the problem ``pending``; a later call returns
        it with the reply.

        `like` selects the exchanges whose fields have the given values: ``exchanges(function=16)``. ``tag="period"`` selects
        those that carry that tag. Frames that answer no request are omitted, unless `strays` is true or ``problem="stray"`` is
        given.

        Raises `TypeError` for a selection that no exchange can match: an unknown field, problem or access.
        """
        __tracebackhide__ = True
        _check(like)
        strays = strays or like.get("problem") == "stray"
        found = [e for e in self._all() if self._is(e, like) and (strays or e.problem != "stray")]
        return sorted(found, key=lambda e: e.t_s)

    def _all(self) -> list[Exchange]:
        __tracebackhide__ = True
        found: list[Exchange] = []
        since = self._since
        while True:
            answer = self._runner.call("exchanges", id=self._bench, since=since)
            found += map(_exchange, answer["exchanges"])
            if not answer["exchanges"]:
                found += map(_exchange, answer["pending"])
                return [e for e in found if e.t_s >= self._after_s]
            since = found[-1].number

    def _is(self, exchange: Exchange, like: dict[str, Any]) -> bool:
        if self._device and exchange.device != self._device:
            return False
        return all(
            value in exchange.tags if key == "tag" else getattr(exchange, key) == value for key, value in like.items()
        )

    def clear(self) -> None:
        """Discard all exchanges until now, including requests that still wait for their reply."""
        while True:
            answer = self._runner.call("exchanges", id=self._bench, since=self._since)
            self._after_s = answer["now_s"]
            if not answer["exchanges"]:
                return
            self._since = answer["exchanges"][-1]["number"]

    def count(self, **like: Any) -> int:
        """Return the number of exchanges that ``exchanges(**like)`` returns. Stray frames are not counted by default."""
        return len(self.exchanges(**like))

    def expect(
        self,
        times: int | None = None,
        within_s: float = 2.0,
        *,
        at_least: int | None = None,
        at_most: int | None = None,
        **like: Any,
    ) -> list[Exchange]:
        """Wait until there are `times` exchanges that `like` selects (by default 1), and return them.

        Instead of `times`, give bounds: `at_least` returns as soon as that number is reached, `at_most` observes for all of
        `within_s`, because one more could come until then. The method waits for the reply to a pending request; if there is none
        at the end of `within_s`, the request counts, also as one with ``no reply``. Raises `AssertionError` with the observed
        traffic if the number differs. The call blocks; in a coroutine use `expect_async`.
        """
        __tracebackhide__ = True
        wanted = _Wanted.of(times, at_least, at_most, like)
        until = time.monotonic() + within_s
        while True:
            found, over = self._look(wanted, like, until)
            if over:
                return found
            time.sleep(POLL_S)

    async def expect_async(
        self,
        times: int | None = None,
        within_s: float = 2.0,
        *,
        at_least: int | None = None,
        at_most: int | None = None,
        **like: Any,
    ) -> list[Exchange]:
        """Do the same as `expect`, without blocking the event loop."""
        __tracebackhide__ = True
        wanted = _Wanted.of(times, at_least, at_most, like)
        until = time.monotonic() + within_s
        while True:
            found, over = await asyncio.to_thread(self._look, wanted, like, until)
            if over:
                return found
            await asyncio.sleep(POLL_S)

    def _look(self, wanted: _Wanted, like: dict[str, Any], until: float) -> tuple[list[Exchange], bool]:
        """Return the exchanges that `like` selects, and whether to stop waiting. `until` is the deadline on the monotonic clock.

        Raises `AssertionError` when the expected number can no longer be reached.
        """
        __tracebackhide__ = True
        late = time.monotonic() >= until
        found = self.exchanges(**like)
        if late and like.get("problem") == "no reply":
            silent = self.exchanges(**{**like, "problem": "pending"})
            found = sorted(found + silent, key=lambda e: e.t_s)
        ended = len(found) if late or like.get("problem") == "pending" else sum(e.problem != "pending" for e in found)
        if len(found) > wanted.most or (late and len(found) < wanted.least):
            there = "\n".join(f"  {e}" for e in self.exchanges(strays=True)[-SHOWN:]) or "  nothing"
            raise AssertionError(f"expected {wanted}; got {len(found)}; on the wire was:\n{there}")
        return found, late or (ended >= wanted.least and not wanted.to_the_end)

    @contextmanager
    def fault(self, name: str, **more: Any) -> Iterator[str]:
        """Inject a fault while the block runs: ``with wire.fault("silence"):``.

        `fieldtwin faults` lists names and parameters.
        """
        __tracebackhide__ = True
        aim = {"device": self._device} if self._device and not {"device", "bus"} & set(more) else {}
        id = self._runner.call("fault", id=self._bench, fault={"name": name, **aim, **_keys(more)})
        try:
            yield id
        finally:
            self._runner.call("clear", id=self._bench, fault=id)


def _check(like: dict[str, Any]) -> None:
    """Raise `TypeError` for a selection that no exchange can match: a test that expects none would always pass."""
    __tracebackhide__ = True
    for key in like.keys() - _FIELDS - {"tag"}:
        names = sorted({*_FIELDS, "tag"})
        hint = did_you_mean(key, names, otherwise=f"expected one of {', '.join(names)}")
        raise TypeError(f"an exchange has no {key!r}; {hint}")
    for key, known in (("problem", PROBLEMS), ("access", ACCESSES)):
        if key in like and like[key] not in known:
            raise TypeError(f"no exchange has the {key} {like[key]!r}; expected one of {', '.join(map(repr, known))}")


def _keys(more: dict[str, Any]) -> dict[str, Any]:
    """Return keyword arguments as a fault file's keys; ``from_`` stands for ``from``, a Python keyword."""
    return {key.removesuffix("_"): value for key, value in more.items()}


@dataclass(frozen=True)
class _Wanted:
    """The expected number of exchanges, and a description of them."""

    least: int
    most: float
    to_the_end: bool
    words: str

    @classmethod
    def of(cls, times: int | None, at_least: int | None, at_most: int | None, like: dict[str, Any]) -> _Wanted:
        __tracebackhide__ = True
        if times is not None and (at_least is not None or at_most is not None):
            raise TypeError("times is exact: give either times, or at_least and at_most")
        if at_least is not None and at_most is not None and at_least > at_most:
            raise TypeError(f"at least {at_least} and at most {at_most} can never be met")
        if times is None and at_least is None and at_most is None:
            times = 1
        fields = ", ".join(f"{key}={value!r}" for key, value in like.items())
        words = "exchange(s)" + (f" with {fields}" if fields else "")
        if times is not None:
            return cls(times, times, times == 0, f"{times} {words}")
        bounds = [f"at least {at_least}"] * (at_least is not None) + [f"at most {at_most}"] * (at_most is not None)
        most = float("inf") if at_most is None else at_most
        return cls(at_least or 0, most, at_most is not None, f"{' and '.join(bounds)} {words}")

    def __str__(self) -> str:
        return self.words
