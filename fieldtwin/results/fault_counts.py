"""How often faults took effect, as a field simulator reports it (`fieldtwin.twin.prototype.fault_history`)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from fieldtwin.results.model import Struck


def struck_of(told: Mapping[str, Any]) -> Struck:
    """Return one entry of a field simulator's history."""
    return Struck(told["id"], told["name"], told["on"], told["struck"], told["optional"])
