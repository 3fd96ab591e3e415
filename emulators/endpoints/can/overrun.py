"""Emulated CAN ends that report to their node that received frames were lost, as a CAN controller does.

The report is an error frame; the node decides how to react.
"""

from __future__ import annotations

from fieldtwin.gateway.core.can_error import overrun_frame
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.connection import CanConnection


class ReportsOverrun(CanConnection):
    """A CAN end that reports lost frames with one error frame, as soon as its receive queue has room again."""

    _unreported = 0

    def on_overrun(self, item: CanFrame) -> None:
        self._unreported = item.t_ns or 1

    def on_room(self) -> None:
        if self._unreported and self._lost is None:
            t_ns, self._unreported = self._unreported, 0
            self.feed(overrun_frame(t_ns))
