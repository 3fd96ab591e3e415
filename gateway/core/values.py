"""The paper's DATA types (docs/explanation/paper.md), and a tag's value with its quality.

DATA is a bit sequence (``bytes``); COMMAND and RESPONSE are DATA, MEASUREMENT and STATUS are RESPONSEs, a RECORDING is
a RESPONSE. All are frozen: received data cannot be changed on the way (the paper's ControlLogic: "payload unaltered").
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import msgspec


@dataclass(frozen=True, slots=True)
class DATA:
    """A bit sequence; `data` holds its bytes."""

    data: bytes


@dataclass(frozen=True, slots=True)
class COMMAND(DATA):
    """A command to a device: its bits, and its name in the device's command list.

    Between the topside controller and the control logic, a command is a period in seconds, signed 16 bit (paper.md, ruling
    17), without a name.
    """

    name: str = ""


@dataclass(frozen=True, slots=True)
class RESPONSE(DATA):
    """A device's response: a MEASUREMENT or a STATUS."""


@dataclass(frozen=True, slots=True)
class MEASUREMENT(RESPONSE):
    """The response with the values that a sensor has sampled."""


@dataclass(frozen=True, slots=True)
class STATUS(RESPONSE):
    """The state of a device or system. Carries state and period (paper.md, ruling 7)."""


@dataclass(frozen=True, slots=True)
class RECORDING(RESPONSE):
    """A response that was recorded earlier."""


class Quality(IntEnum):
    """The quality of a value, with the classes of IEC 62541 (good, uncertain, bad). A larger number is a worse quality."""

    GOOD = 0
    SUBSTITUTED = 1
    SIMULATED = 2
    UNCERTAIN = 3
    BAD = 4

    def __str__(self) -> str:
        return self.name.lower()


class Reason(IntEnum):
    """The reason why a value is not good. The members are small integers, so that they fit into the process image."""

    NONE = 0
    NEVER_READ = 1
    TIMEOUT = 2
    WIRE_ERROR = 3
    REFUSED = 4
    UNREACHABLE = 5
    STALE = 6
    NOT_SAMPLING = 7
    NOT_A_NUMBER = 8
    OUT_OF_RANGE = 9
    NOT_OPERATIONAL = 10
    HEARTBEAT_LOST = 11
    WRONG_DEVICE = 12
    GATEWAY_DEAD = 13
    SENTINEL = 14
    NOT_EXACT = 15

    def __str__(self) -> str:
        return self.name.lower().replace("_", " ")


Scalar = bool | int | float | str | bytes


class TagValue(msgspec.Struct, frozen=True, gc=False):
    """A tag's value at an instant.

    Every reply creates such values, and creating a frozen dataclass costs ten times as much as a `msgspec` struct.
    `msgspec.structs.replace` returns a changed copy.

    `value` is in engineering units, or None if there has been no value yet. `t_ns` is the source's monotonic time at
    which the reply that carried the value was complete. `raw` holds the bytes that the device sent, empty if it sent
    none.
    """

    value: Scalar | None
    quality: Quality
    reason: Reason = Reason.NONE
    t_ns: int = 0
    raw: bytes = b""

    @property
    def good(self) -> bool:
        return self.quality is Quality.GOOD

    def age_s(self, now_ns: int) -> float:
        """Return the seconds since the source had this value; infinite if there never was a value."""
        return (now_ns - self.t_ns) / 1e9 if self.t_ns else float("inf")

    def describe(self, now_ns: int) -> dict[str, Scalar | None]:
        """Return a JSON-able description: value (bytes as hex), quality, reason, and age in seconds (None if there has
        been no value).
        """
        return {
            "value": self.value.hex() if isinstance(self.value, bytes) else self.value,
            "quality": str(self.quality),
            "reason": str(self.reason),
            "age_s": self.age_s(now_ns) if self.t_ns else None,
        }


NEVER = TagValue(None, Quality.BAD, Reason.NEVER_READ)
