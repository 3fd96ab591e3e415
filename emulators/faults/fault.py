"""What a fault is: a name, what it aims at, its parameters, and what it makes of a frame.

Pure: a fault is handed a frame and a random generator of its own, and answers with what shall happen; the engine carries it
out. It never opens, waits or reads a clock.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from random import Random
from typing import Any, ClassVar, Literal

from pydantic import BaseModel, ConfigDict, Field

from fieldtwin.emulators.faults.frames import Frame, Way
from fieldtwin.gateway.core.profile import Tag


class Hang(Enum):
    """What becomes of a connection."""

    CLOSE = "close"
    """It is ended in order (FIN); on a serial line nothing can be ended."""
    RESET = "reset"
    """It is torn down at once (RST)."""
    HALF_OPEN = "half_open"
    """Nothing passes any more, and nobody is told."""


@dataclass(frozen=True, slots=True)
class Piece:
    """Bytes that go on, `delay_s` after the frame was there and behind what still waits.

    `overtake`: past what still waits. `gather`: together with what comes within that time. `back`: to whoever sent it.
    """

    data: bytes
    delay_s: float = 0.0
    overtake: bool = False
    gather: bool = False
    back: bool = False
    gone: Callable[[], bool] | None = None
    """Whether it went by itself meanwhile, asked when its time has come."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a fault makes of a frame: pieces in order, and what becomes of the connection behind them."""

    pieces: tuple[Piece, ...] = ()
    hang: Hang | None = None


def passed(*data: bytes) -> Outcome:
    """These bytes, at once."""
    return Outcome(tuple(Piece(d) for d in data))


LOST = Outcome()


class Aim(BaseModel):
    """What a fault strikes. What is not said matches everything."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)

    bus: str = ""
    device: str = ""
    unit: int | None = Field(default=None, ge=0, le=255)
    function: int | None = Field(default=None, ge=1, le=127)
    address: str | int | None = None
    """A PDU address, or ``holding:0x10``."""
    registers: str | int | None = None
    """How many registers or bits the request reads or writes: ``40``, ``65..125`` or ``65..``."""
    register_: str = Field(default="", alias="register")
    """A tag of the device."""
    cob_id: int | None = Field(default=None, ge=0, le=0x7FF)
    index: int | None = Field(default=None, ge=0, le=0xFFFF)
    """An object of CANopen: SDO requests and replies that name it."""
    direction: Literal["request", "reply", "both", ""] = ""
    nth: int | None = Field(default=None, ge=1)
    every: int | None = Field(default=None, ge=1)
    from_: str | float | int = Field(default=0, alias="from")
    until: str | float | int | None = None
    probability: float = Field(default=1.0, ge=0.0, le=1.0)
    optional: bool = False
    """A run in which the fault never struck has tested something all the same."""


class Parameters(BaseModel):
    """A fault's own parameters; each has a default, and its unit in its name."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


HEX = r"^([0-9A-Fa-f]{2} ?)*$"
"""Bytes that a parameter spells out."""


class Nothing(Parameters):
    """None."""


class Kind(Enum):
    """Where a fault can be put."""

    BYTES = "serial lines and sockets"
    CAN = "CAN buses"
    VALUE = "values of a device"


class Fault(ABC):
    """One kind of fault, made with its parameters. The class is the catalogue's entry."""

    name: ClassVar[str]
    summary: ClassVar[str]
    kind: ClassVar[Kind]
    form: ClassVar[type[Parameters]] = Nothing
    ways: ClassVar[frozenset[Way]] = frozenset((Way.REPLY,))
    """Which way it strikes where its aim does not say."""
    codes: ClassVar[Mapping[int, str]] = {}
    """What the standard knows for its parameter `code`."""

    def __init__(self, parameters: Parameters) -> None:
        self.parameters: Any = parameters


class WireFault(Fault):
    """Strikes frames on serial lines and sockets."""

    kind = Kind.BYTES

    @abstractmethod
    def strike(self, frame: Frame, random: Random) -> Outcome:
        """What becomes of `frame`."""

    def appears(self) -> Hang | None:
        """What becomes of connections that are open when the fault is put in."""
        return None

    refuses: ClassVar[bool] = False
    """Whether nobody can connect while it lasts."""
    divides: ClassVar[bool] = False
    """Whether it delivers the frame in several pieces, all bytes unchanged. Such a fault strikes after all others: they expect a
    whole frame, and bytes that they add to a piece would lie inside the frame, where Modbus TCP cannot notice them."""


class ValueFault(Fault):
    """Changes what a device holds."""

    kind = Kind.VALUE
    ways: ClassVar[frozenset[Way]] = frozenset()

    def learn(self, tags: Iterable[Tag]) -> None:
        """Take note of the tags of the device that the fault is put into, before it strikes."""

    def on(self, tag: str) -> ValueFault | None:
        """Return the fault as it strikes `tag`; None where it leaves that tag alone."""
        return self

    @abstractmethod
    def distort(self, value: float, since_s: float, held: float, random: Random) -> float:
        """The value instead of `value`. `since_s`: seconds since the fault began; `held`: what it was then."""


@dataclass
class Active:
    """A fault that is in: what it strikes, until when, and how often it did."""

    id: str
    fault: Fault
    aim: Aim
    random: Random
    from_ns: int
    until_ns: int | None
    matched: int = 0
    struck: int = 0
    units: Sequence[int] = field(default_factory=tuple)
    """Units that `device` and `bus` stand for; none: all."""
    addresses: range | None = None
    counts: range | None = None
    functions: frozenset[int] = frozenset()
    """Those of the table that the addresses are in; none: all."""

    def strikes(self, frame: Frame, now_ns: int) -> bool:
        """Whether it strikes this frame; counts what matches."""
        aim = self.aim
        if now_ns < self.from_ns or (self.until_ns is not None and now_ns >= self.until_ns):
            return False
        if aim.direction not in ("both", "") and frame.way is not Way(aim.direction):
            return False
        if not aim.direction and frame.way not in self.fault.ways:
            return False
        nobody_knows = frame.unit == -1 and aim.unit is None and not aim.device
        if self.units and frame.unit not in self.units and not nobody_knows:
            return False
        if aim.function is not None and frame.function != aim.function:
            return False
        if self.functions and frame.function not in self.functions:
            return False
        if self.addresses is not None and frame.address not in self.addresses:
            return False
        if self.counts is not None and frame.count not in self.counts:
            return False
        self.matched += 1
        if aim.nth is not None and self.matched != aim.nth:
            return False
        if aim.every is not None and self.matched % aim.every:
            return False
        if aim.probability < 1.0 and self.random.random() >= aim.probability:
            return False
        self.struck += 1
        return True
