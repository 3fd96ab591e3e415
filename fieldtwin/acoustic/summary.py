"""The verdict on a run of a network. It consists of the verdicts on its systems and the events in the acoustic channel."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from fieldtwin.__about__ import __version__


def summarise_network(
    name: str,
    systems: Mapping[str, dict[str, Any]],
    channel: Mapping[str, Any],
    errors: Sequence[str],
    elapsed_s: float,
) -> dict[str, Any]:
    """Return the summary as plain data, for `--json` and for printing. `ok` is true if all systems are ok and nothing else
    failed.

    `systems`: each system's own summary. `channel`: ``water`` (the counters of each modem), ``faults`` (of the channel)
    and ``ship`` (the commands and responses of the topside modem; None without one).
    """
    return {
        "fieldtwin": __version__,
        "network": name,
        "prototype": True,
        "systems": dict(systems),
        **channel,
        "errors": list(errors),
        "ok": not errors and all(one["ok"] for one in systems.values()),
        "duration_s": round(elapsed_s, 3),
    }
