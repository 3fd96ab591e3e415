"""An error on the bus: a frame is destroyed and sent again by its controller."""

from __future__ import annotations

from fieldtwin.emulators.faults.can_fault import BusFault


class ErrorFrame(BusFault):
    name = "error-frame"
    summary = "the node's frames are destroyed on the wire now and then, and sent again by its controller (a modelled bus only)"
