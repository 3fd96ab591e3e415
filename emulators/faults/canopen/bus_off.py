"""A node with so many errors that its controller leaves the bus."""

from __future__ import annotations

from fieldtwin.emulators.faults.can_fault import BusFault


class BusOff(BusFault):
    name = "bus-off"
    summary = (
        "each attempt of the node to send is destroyed until its controller is in bus-off (only on a modelled bus)"
    )
    attempts = 32
