"""The header of a command's JSON, from which the site acceptance document takes device, user, time and command line."""

from __future__ import annotations

import shlex
import sys
from datetime import UTC, datetime
from typing import Any

from fieldtwin.__about__ import __version__
from fieldtwin.results.subject import who


def headed(
    kind: str, protocol: str, endpoint: str, address: int, against: str, *, device: str = "", when: str = ""
) -> dict[str, Any]:
    """Return ``{"kind": "fieldtwin compare", "version": 1, "about": {...}}`` to put before a command's results.

    `endpoint` is empty if there was no live device; `device` then names the file that replaces it. `against` is the reference of
    the comparison. `when` is ISO 8601, now by default.
    """
    return {
        "kind": f"fieldtwin {kind}",
        "version": 1,
        "about": {
            "protocol": protocol,
            "endpoint": endpoint,
            "address": address,
            "device": device,
            "against": against,
            "started": when or datetime.now(UTC).isoformat(timespec="seconds"),
            "by": who(),
            "command": "fieldtwin " + shlex.join(sys.argv[1:]),
            "fieldtwin": __version__,
        },
    }
