"""Describe how often faults took effect, for the end of a run. A fault that never took effect has tested nothing."""

from __future__ import annotations

from fieldtwin.emulators.faults.fault import Active


def effect_text(active: Active) -> str:
    """Return a line about one fault: its ID and name, and how often it took effect on frames that matched its aim."""
    named = active.id if active.id.startswith(active.fault.name) else f"{active.id} ({active.fault.name})"
    if active.struck and not active.matched:
        return f"{named}: {active.struck} times"
    return f"{named}: took effect on {active.struck} of {active.matched} frames"
