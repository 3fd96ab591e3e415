"""A case for a device, the frames exchanged in it, and its finding. This module does not depend on a protocol.

A device is tested from outside, through its replies and its silence, as its client or master sees it.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

from fieldtwin.conformance.core.case import About, Finding
from fieldtwin.conformance.core.results import CaseResult
from fieldtwin.gateway.core.connection import Direction

W = TypeVar("W")
CaseProcedure = Callable[[W], Awaitable[Finding]]
"""Runs a case on a connection and returns the finding."""


@dataclass(frozen=True, slots=True)
class DeviceCase(About, Generic[W]):
    """A case for devices.

    `play` runs the case. `wires`: the transports on which the case applies; empty for all. `needs`: inputs that the user
    has to give for it (``holding``, ``coil``, ``object``: by ``--write``; ``eds``; ``i-know``).
    """

    play: CaseProcedure[W]
    wires: tuple[str, ...] = ()
    needs: tuple[str, ...] = ()

    @property
    def role(self) -> str:
        return "device"


@dataclass(frozen=True, slots=True)
class Spoken:
    """Bytes or a frame that were sent or received. `t_ns` counts from the start of the case, `text` is hex or a frame in
    candump's notation.
    """

    t_ns: int
    direction: Direction
    text: str


@dataclass(frozen=True, slots=True)
class DeviceResult(CaseResult):
    """The finding of a device case, and all frames of the case."""

    spoken: tuple[Spoken, ...] = ()


class NotHere(Exception):
    """Raised inside a case if the device lacks the tested feature. The case is skipped, with the message as the reason."""


class Unsaid(Exception):
    """Raised inside a case that cannot be decided from outside. The case is inconclusive, with the message as the reason."""
