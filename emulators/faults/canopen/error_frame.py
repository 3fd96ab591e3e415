"""An error on the bus: a frame is destroyed and sent again by its controller."""

from __future__ import annotations

from fieldtwin.emulators.faults.can_fault import BusFault


class ErrorFrame(BusFault):
    name = "error-frame"
    summary = (
        "some frames of the node are destroyed on the bus, and its controller repeats them (only on a modelled bus)"
    )
