"""How often faults took effect, as a field simulator reports it (`fieldtwin.twin.prototype.fault_history`)."""

from __future__ import annotations

from fieldtwin.results.model import Struck
from fieldtwin.twin.prototype.field_status import StruckStatus


def struck_of(told: StruckStatus) -> Struck:
    """Return an entry of a field simulator's fault history as a `Struck`."""
    return Struck(told.id, told.name, told.on, told.struck, told.optional)
