"""The classes of faults. A fault has a name, an aim (the frames or values that it changes), parameters, and an effect on each
of these frames.

A fault receives a frame and its own random generator, and returns the effect, which the connection carries out. A fault never
opens connections, waits or reads a clock.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from random import Random
from typing import Any, ClassVar, Literal

from pydantic import BaseModel, ConfigDict, Field

from fieldtwin.emulators.faults.frames import EVERY_FRAMING, FaultFrame, FrameDirection, Framing
from fieldtwin.gateway.core.files.profile import Tag


class ConnectionEffect(Enum):
    """The effect of a fault on a connection."""

    CLOSE = "close"
    """The connection is closed in order (FIN); on a serial line there is no connection to close."""
    RESET = "reset"
    """The connection is reset at once (RST)."""
    HALF_OPEN = "half_open"
    """No bytes pass any more, and neither side is notified."""


@dataclass(frozen=True, slots=True)
class DelayedBytes:
    """Bytes that are forwarded `delay_s` after the frame arrived, and after all bytes that still wait.

    With `overtake` they are forwarded before bytes that still wait, with `gather` together with bytes that arrive within that
    time. With `back` they are returned to the sender.
    """

    data: bytes
    delay_s: float = 0.0
    overtake: bool = False
    gather: bool = False
    back: bool = False
    gone: Callable[[], bool] | None = None
    """A function that is called when the delay has ended, and returns whether the bytes were forwarded already."""


@dataclass(frozen=True, slots=True)
class FaultEffect:
    """The effect of a fault on a frame: pieces in order, and the effect on the connection after them."""

    pieces: tuple[DelayedBytes, ...] = ()
    connection: ConnectionEffect | None = None


def passed(*data: bytes) -> FaultEffect:
    """Return an effect that forwards these bytes without delay."""
    return FaultEffect(tuple(DelayedBytes(d) for d in data))


LOST = FaultEffect()


class Aim(BaseModel):
    """The frames or values that a fault changes. A key that is not given matches all frames or values."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)

    bus: str = ""
    device: str = ""
    unit: int | None = Field(default=None, ge=0, le=255)
    function: int | None = Field(default=None, ge=1, le=127)
    address: str | int | None = None
    """The address of a register or bit: a PDU address, or ``holding:0x10``."""
    registers: str | int | None = None
    """The number of registers or bits that the request reads or writes: ``40``, ``65..125`` or ``65..``."""
    register_: str = Field(default="", alias="register")
    """The name of a tag of the device: requests for its registers match."""
    cob_id: int | None = Field(default=None, ge=0, le=0x7FF)
    index: int | None = Field(default=None, ge=0, le=0xFFFF)
    """The index of a CANopen object: SDO requests and replies for this object match."""
    direction: Literal["request", "reply", "both", ""] = ""
    nth: int | None = Field(default=None, ge=1)
    every: int | None = Field(default=None, ge=1)
    from_: str | float | int = Field(default=0, alias="from")
    until: str | float | int | None = None
    probability: float = Field(default=1.0, ge=0.0, le=1.0)
    optional: bool = False
    """True: a run passes even if the fault never took effect."""


class Parameters(BaseModel):
    """The parameters of one kind of fault; each has a default, and its unit in its name."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


HEX = r"^([0-9A-Fa-f]{2} ?)*$"
"""The pattern of a parameter that gives bytes in hexadecimal."""


class Nothing(Parameters):
    """The empty form of a fault that needs no parameters."""


class InjectionPoint(Enum):
    """The places at which a fault can be injected."""

    BYTES = "serial lines and sockets"
    CAN = "CAN buses"
    VALUE = "values of a device"


class Fault(ABC):
    """One kind of fault, created with its parameters. The class attributes describe it in the list of faults."""

    name: ClassVar[str]
    summary: ClassVar[str]
    kind: ClassVar[InjectionPoint]
    form: ClassVar[type[Parameters]] = Nothing
    ways: ClassVar[frozenset[FrameDirection]] = frozenset((FrameDirection.REPLY,))
    """The directions of the frames that the fault changes if its aim does not name a direction."""
    codes: ClassVar[Mapping[int, str]] = {}
    """The meanings that the standard gives to values of the parameter `code`."""

    def __init__(self, parameters: Parameters) -> None:
        self.parameters: Any = parameters


class WireFault(Fault):
    """A fault that changes frames on serial lines and sockets."""

    kind = InjectionPoint.BYTES

    @abstractmethod
    def apply(self, frame: FaultFrame, random: Random) -> FaultEffect:
        """Return the effect on `frame`."""

    def appears(self) -> ConnectionEffect | None:
        """Return the effect on connections that are open when the fault is injected."""
        return None

    refuses: ClassVar[bool] = False
    """Whether new connections are refused while the fault lasts."""
    framings: ClassVar[frozenset[Framing]] = EVERY_FRAMING
    """The framings whose frames the fault can change; on any other one it is refused when its file is loaded."""
    functions: ClassVar[frozenset[int]] = frozenset()
    """The function codes whose frames the fault can change; empty: all."""
    divides: ClassVar[bool] = False
    """Whether the fault delivers the frame in several pieces, with all bytes unchanged.

    Such a fault is applied after all others. The others expect a whole frame, and bytes that they add to a piece would
    lie inside the frame, where Modbus TCP cannot detect them.
    """


class ValueFault(Fault):
    """A fault that changes the values that a device holds."""

    kind = InjectionPoint.VALUE
    ways: ClassVar[frozenset[FrameDirection]] = frozenset()

    def learn(self, tags: Iterable[Tag]) -> None:
        """Record the tags of the device into which the fault is injected, before the fault changes any value."""

    def on(self, tag: str) -> ValueFault | None:
        """Return the instance of the fault that changes `tag`, or None if the fault does not change that tag."""
        return self

    @abstractmethod
    def distort(self, value: float, since_s: float, held: float, random: Random) -> float:
        """Return the replacement of `value`. The fault began `since_s` seconds ago, when the value was `held`."""


@dataclass
class Active:
    """An injected fault: its aim, its start and end, and the number of times that it took effect (`struck`)."""

    id: str
    fault: Fault
    aim: Aim
    random: Random
    from_ns: int
    until_ns: int | None
    matched: int = 0
    struck: int = 0
    units: Sequence[int] = field(default_factory=tuple)
    """The unit IDs that `device` and `bus` stand for; empty: all."""
    addresses: range | None = None
    counts: range | None = None
    functions: frozenset[int] = frozenset()
    """Function codes of the table that contains the addresses; empty: all."""

    def applies_to(self, frame: FaultFrame, now_ns: int) -> bool:
        """Return whether the fault is to change this frame, and count frames that match its aim.

        If the fault then changes the frame, the caller increases `struck`. A fault that never took effect has tested nothing.
        """
        aim = self.aim
        if now_ns < self.from_ns or (self.until_ns is not None and now_ns >= self.until_ns):
            return False
        if aim.direction not in ("both", "") and frame.way is not FrameDirection(aim.direction):
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
        return not (aim.probability < 1.0 and self.random.random() >= aim.probability)
