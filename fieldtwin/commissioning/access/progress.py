"""The progress of a long command, for display."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class PhaseProgress:
    """The name of the current phase, and its elapsed and estimated seconds (`total_s` 0: not known)."""

    phase: str
    done_s: float
    total_s: float
    detail: str = ""
    found: int = 0
