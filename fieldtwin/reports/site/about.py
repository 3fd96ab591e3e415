"""What stands above the JSON of a verb, so that a site acceptance document knows which device, who, when, by which words."""

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
    """``{"kind": "fieldtwin compare", "version": 1, "about": {...}}`` to put in front of what the verb found.

    `endpoint` is empty where no live device was asked, `device` then says what stands for it; `against` is what it was held
    against. `when` is ISO 8601, now if not said.
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
