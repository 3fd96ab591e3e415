"""How often faults struck, for the end of a run: a fault that never struck has tested nothing."""

from __future__ import annotations

from fieldtwin.emulators.faults.fault import Active


def struck(active: Active) -> str:
    """One fault: its id and name, and how many of the frames that matched it struck."""
    named = active.id if active.id.startswith(active.fault.name) else f"{active.id} ({active.fault.name})"
    if active.struck and not active.matched:
        return f"{named}: {active.struck} times"
    return f"{named}: struck {active.struck} of {active.matched} frames"
