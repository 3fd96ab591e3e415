"""The verdict on a run of a network: those on its systems, and the events in the acoustic channel."""

from __future__ import annotations

from typing import Any

from fieldtwin.__about__ import __version__
from fieldtwin.twin.network.network import Network


def summarise_network(
    network: Network,
    systems: dict[str, dict[str, Any]],
    water: dict[str, dict[str, int]],
    ship: dict[str, Any] | None,
    errors: list[str],
    water_faults: list[dict[str, Any]],
) -> dict[str, Any]:
    """Return plain data for `--json` and for printing.

    `systems`: each system's own summary. `ok` if all of them are, and nothing else failed.
    """
    return {
        "fieldtwin": __version__,
        "network": network.name,
        "prototype": True,
        "systems": systems,
        "water": water,
        "faults": water_faults,
        "ship": ship,
        "errors": errors,
        "ok": not errors and all(one["ok"] for one in systems.values()),
    }
