"""What a case for a device is, what is said on the wire in it, and what was found. It knows no protocol.

A device is judged from outside, as its master sees it: by what it answers, and when it keeps silent.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

from fieldtwin.conformance.case import About, Finding
from fieldtwin.conformance.results import CaseResult
from fieldtwin.gateway.core.connection import Direction

W = TypeVar("W")
Play = Callable[[W], Awaitable[Finding]]
"""Plays a case on a wire and judges it."""


@dataclass(frozen=True, slots=True)
class DeviceCase(About, Generic[W]):
    """A case for devices. `wires`: on which it makes sense, all where none are named. `needs`: what the user has to
    give for it (``holding``, ``coil``, ``object``: by ``--write``; ``eds``; ``i-know``)."""

    play: Play[W]
    wires: tuple[str, ...] = ()
    needs: tuple[str, ...] = ()

    @property
    def role(self) -> str:
        return "device"


@dataclass(frozen=True, slots=True)
class Spoken:
    """A chunk or a frame. `t_ns` counts from the case's beginning, `text` is hex, or a frame as candump writes it."""

    t_ns: int
    direction: Direction
    text: str


@dataclass(frozen=True, slots=True)
class DeviceResult(CaseResult):
    """What was found, and all that was said meanwhile."""

    spoken: tuple[Spoken, ...] = ()


class NotHere(Exception):
    """Raised inside a play: the device has nothing that the case is about. The case is skipped with this reason."""


class Unsaid(Exception):
    """Raised inside a play: it cannot be told from outside. The case is inconclusive for this reason."""
