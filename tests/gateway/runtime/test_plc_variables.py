"""Writes of clients to variables of the PLC: messages in the process image, and their end."""

from __future__ import annotations

import json

from fieldtwin.gateway.core.errors import EndpointBusy, FieldtwinError, NotAllowed, Unreachable
from fieldtwin.gateway.core.image.image import INPUTS, OUTPUTS, TagKind, TagSpec, consumed_name, process_image
from fieldtwin.gateway.core.values import Quality, Reason
from fieldtwin.gateway.runtime.image_io import ImageExchange
from fieldtwin.gateway.runtime.plc_variables import MAX_WRITES, PlcVariables, writes_tag
from fieldtwin.gateway.runtime.tags import TagTable

S = 1_000_000_000


class Clock:
    now_ns = 1

    def monotonic_ns(self) -> int:
        return self.now_ns


class Bench:
    """The gateway's exchange, and a PLC that takes messages when the test wants it."""

    def __init__(self) -> None:
        layout = process_image([writes_tag("p")], [TagSpec("p.n", TagKind.INT)])
        memory = memoryview(bytearray(layout.size))
        layout.format(memory)
        image = layout.attach(memory)
        self.clock = Clock()
        self.variables = PlcVariables(["p"], self.clock)  # type: ignore[arg-type]
        self.variables.exchange = ImageExchange(image, TagTable(self.clock), self.variables.sources)  # type: ignore[arg-type]
        self.variables.alive = True
        self.plc, self.written = image.writer(OUTPUTS), image.reader(INPUTS)
        self.taken = 0
        self.ended: list[FieldtwinError | None] = []

    def write(self, **values: float) -> None:
        self.variables.request({"p": values}, self.ended.append)

    def tick(self) -> None:
        self.variables.exchange.exchange(self.clock.now_ns)
        self.variables.tick(self.clock.now_ns)

    def scan(self) -> list[object]:
        """Let the PLC take the new messages, and return them."""
        messages = self.written.snapshot().messages.get("p.st_writes", ())
        self.taken += len(messages)
        values = {"p.n": 5, consumed_name("p.st_writes"): self.taken}
        tags = self.plc.shape.layout.tags
        self.plc.publish_columns([values[tag.name] for tag in tags], Quality.GOOD, Reason.NONE, self.clock.now_ns, None)
        return [json.loads(message.data) for message in messages]


def test_a_write_ends_when_the_program_has_taken_it() -> None:
    bench = Bench()
    bench.write(n=7, m=1)
    bench.write(n=8)
    bench.tick()
    assert bench.ended == []
    assert not bench.variables.is_idle
    assert bench.scan() == [{"n": 7, "m": 1}, {"n": 8}]
    bench.tick()
    assert bench.ended == [None, None]
    assert bench.variables.is_idle


def test_a_write_that_no_program_takes_ends_with_an_error() -> None:
    bench = Bench()
    bench.write(n=7)
    bench.clock.now_ns += 3 * S
    bench.tick()
    (error,) = bench.ended
    assert isinstance(error, Unreachable)


def test_too_many_writes_and_too_large_ones_are_refused() -> None:
    bench = Bench()
    for _ in range(MAX_WRITES + 1):
        bench.write(n=7)
    assert [type(error) for error in bench.ended] == [EndpointBusy]
    other = Bench()
    other.write(**{f"{'n' * 100}{number}": 1 for number in range(400)})
    assert [type(error) for error in other.ended] == [NotAllowed]


def test_nothing_is_read_or_written_while_the_plc_does_not_run() -> None:
    bench = Bench()
    bench.scan()
    bench.tick()
    assert (bench.variables.current("p.n").value, bench.variables.current("p.n").good) == (5, True)
    bench.variables.alive = False
    assert bench.variables.current("p.n").quality is Quality.BAD
    bench.write(n=7)
    assert [type(error) for error in bench.ended] == [Unreachable]
