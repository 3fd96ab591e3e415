"""The message of `fieldtwin record` when nothing was recorded: for how long it listened, and what to check.

The checks depend on the kind of the recording, because a silent bus, a silent tap and a device that was never asked have
different causes.
"""

from __future__ import annotations

NOTHING_RECORDED = 1
"""Exit code if nothing was recorded. A scan that finds no device ends with the same code."""

OF_BUS = (
    "check the bit rate, the wiring with its termination, and whether a node sends: most nodes are silent until a master asks "
    "them, and --profile or --eds asks"
)
OF_TAP = "check that the client uses side A and sends requests, and the wiring of both sides"
OF_SNIFFER = (
    "check that a client sends requests, the wiring (A and B), baud rate and frame; "
    "`fieldtwin line` lists possible causes"
)
OF_POLLING = "check that the profile has readable tags, and let the recording run for at least one round"


def nothing_recorded(what: str, where: str, seconds: float, check: str) -> str:
    """Return the message: `what`, such as ``no byte passed``, `where`, and in how many seconds; `check` is the remedy."""
    return f"nothing was recorded: {what} at {where} in {seconds:.1f} s; {check}"
