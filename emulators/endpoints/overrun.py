"""Emulated CAN ends that tell their node when frames came faster than it took them, as a CAN controller does.

The frame that says so is an error frame; what a node makes of it is not known here.
"""

from __future__ import annotations

from fieldtwin.gateway.core.can_error import overrun_frame
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.connection import CanConnection


class TellsOverrun(CanConnection):
    """A CAN end whose receive queue lost frames says so as soon as it has room again: one error frame for all of them."""

    _untold = 0

    def on_overrun(self, item: CanFrame) -> None:
        self._untold = item.t_ns or 1

    def on_room(self) -> None:
        if self._untold and self._lost is None:
            t_ns, self._untold = self._untold, 0
            self.feed(overrun_frame(t_ns))
