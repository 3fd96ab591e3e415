"""The results of decoding: a request with its answer, or a message that has none, as frozen values.

One form for both protocols, so that scenarios and reports can count and compare without depending on either.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

from fieldtwin.gateway.core.files.profile import RegisterRange, Table
from fieldtwin.gateway.core.values import Scalar

SECRET = "(secret)"
"""The replacement for a secret tag's value."""

Access = Literal["read", "write"]


@dataclass(frozen=True, slots=True)
class TouchedSpan:
    """A range of registers or bits, or a CANopen object, that an exchange reads or writes.

    It is `count` registers or bits of `table` from `address`, or (table ``object``) the one object with the index `address`.
    """

    access: Access
    table: Table | Literal["object", "file"]
    address: int
    count: int = 1
    subindex: int = 0

    def covers(self, table: str, address: int) -> bool:
        """Return whether a register (or bit) is inside the span."""
        return self.table == table and self.address <= address < self.address + self.count

    def __str__(self) -> str:
        """Return the address, in both notations for registers: ``30001 (input:0) x 2``; ``6010h:01`` for an object."""
        if self.table == "object":
            return f"{self.address:04X}h:{self.subindex:02X}"
        if self.table == "file":
            return f"file {self.subindex} record {self.address} x {self.count}"
        return str(RegisterRange(self.table, self.address, self.count))


@dataclass(frozen=True, slots=True)
class DecodedExchange:
    """A request and its answer on a bus, or a message that has no answer (broadcast, heartbeat, PDO).

    `unit` is the Modbus unit ID or CANopen node ID (0: all), `device` the system's name of it, "" where it has none. `function`
    is the Modbus function code, 0 on CANopen; `service` is the operation in words, the same for all of a kind: ``read holding
    registers``, ``SDO upload``, ``TPDO1``. `tags` are the values that the exchange carried, in engineering units, None for
    those that were requested but not returned; `registers` are the register words, or 0 and 1 for bits.

    `problem` is the reason why there is no good answer, "" for a good answer: ``no reply``, ``check sum``, ``exception``,
    ``abort``, ``stray`` (a frame that answers no request), ``malformed``; ``pending`` while the answer may still come,
    which only `Decoder.pending` gives. `transaction` is the transaction ID on Modbus TCP, None elsewhere. `latency_ns`
    is from the request to the last byte of the answer, None without one. `t_ns` is when the request was seen, `end_ns`
    the time of its last byte. `text` describes the request, `reply_text` the answer. `value` is the value of an SDO
    transfer (engineering units where it is a tag, hex where its type is not known), an EMCY's code, a heartbeat's
    state.
    """

    t_ns: int
    end_ns: int
    bus: str
    device: str
    unit: int
    function: int
    service: str
    spans: tuple[TouchedSpan, ...] = ()
    registers: tuple[int, ...] = ()
    tags: dict[str, Scalar | None] = field(default_factory=dict)
    exception: int | None = None
    abort: int | None = None
    latency_ns: int | None = None
    request: bytes = b""
    reply: bytes = b""
    problem: str = ""
    text: str = ""
    reply_text: str = ""
    value: Scalar | None = None
    secrets: frozenset[str] = frozenset()
    """The secret tags of the exchange. If "" is among them, its raw register words are secret too. Checks of a scenario can
    still compare the values.
    """
    transaction: int | None = None

    @property
    def access(self) -> str:
        """Return "read", "write", "read and write", or "" if the exchange does neither."""
        return " and ".join(a for a in ("read", "write") if any(s.access == a for s in self.spans))

    @property
    def address(self) -> int | None:
        """Return the first address (CANopen: index) that the exchange accesses."""
        return self.spans[0].address if self.spans else None

    @property
    def count(self) -> int:
        """Return the number of registers, bits or objects of the first span."""
        return self.spans[0].count if self.spans else 0

    @property
    def is_stray(self) -> bool:
        """Return whether this is a frame that answers no request. It must never be counted as a request."""
        return self.problem == "stray"

    @property
    def ok(self) -> bool:
        """Return whether the request was answered well, or the message needs no answer."""
        return not self.problem

    def reads(self, tag: str = "") -> bool:
        """Return whether the exchange reads values and, if `tag` (a name without its device) is given, whether it reads that
        tag.
        """
        return any(s.access == "read" for s in self.spans) and (not tag or tag in self.tags)

    def describe(self) -> dict[str, Any]:
        """Return plain data for JSON, without the values of secrets."""
        return {
            "device": self.device,
            "unit": self.unit,
            "function": self.function,
            "service": self.service,
            "spans": [f"{s.access} {s}" for s in self.spans],
            "registers": [] if self.secrets else list(self.registers),
            "tags": {name: SECRET if name in self.secrets else value for name, value in self.tags.items()},
            "value": SECRET if self.secrets and self.value is not None else self.value,
            "exception": self.exception,
            "abort": self.abort,
            "latency_ms": None if self.latency_ns is None else self.latency_ns / 1e6,
            "problem": self.problem,
        }

    def writes(self, tag: str = "") -> bool:
        """Return whether the exchange writes, and if given, whether it writes `tag` (a name without its device)."""
        return any(s.access == "write" for s in self.spans) and (not tag or tag in self.tags)


@dataclass(frozen=True, slots=True)
class Decoded:
    """The description of one event of a trace. `fields` are the fields of its frame as plain data, and `exchanges` the
    exchanges that the event completed."""

    text: str
    fields: dict[str, Any] = field(default_factory=dict)
    exchanges: tuple[DecodedExchange, ...] = ()
