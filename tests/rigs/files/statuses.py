"""Statuses of a gateway for tests of its readers: what a test does not state has a plain default."""

from __future__ import annotations

from typing import Any

import msgspec

from fieldtwin.gateway.runtime.gateway_status import GatewayStatus

DEVICE = {"bus": "line1", "address": 1, "online": True, "error": "", "identity_error": "", "polls": 0, "errors": 0}
LATENCY = {"bounds_ms": [1], "counts": [0, 0], "total_s": 0.0}
BUS = {"endpoint": "", "connected": True, "opens": 1, "local": [], "error": "", "counters": {}, "latency": LATENCY}
TAG = {"value": None, "quality": "good", "reason": "none", "age_s": None}
OUTPUT = {"wanted": None, "held": None, "by": "plc", "refused": False}
MAILBOX = dict.fromkeys(("received", "sent", "taken", "waits", "queued", "dropped", "commands_refused"), 0)
WRITES = {"allowed": False, **dict.fromkeys(("done", "failed", "refused", "repeated", "superseded"), 0), "safe": False}
REFUSALS = {"total": 0, "entries_made": 0, "unrecorded": 0, "faults": {}, "counts": {}, "entries": []}
PLC = {"alive": True, "age_ms": None, "losses": 0, "stopped": False}


def gateway_status(**stated: Any) -> GatewayStatus:
    """Return a status with the parts that are `stated` as data for JSON."""
    whole = {
        "devices": {name: DEVICE | one for name, one in stated.pop("devices", {}).items()},
        "buses": {name: BUS | one for name, one in stated.pop("buses", {}).items()},
        "tags": {name: TAG | one for name, one in stated.pop("tags", {}).items()},
        "outputs": [OUTPUT | one for one in stated.pop("outputs", [])],
        "mailboxes": {name: MAILBOX | one for name, one in stated.pop("mailboxes", {}).items()},
        "writes": WRITES | stated.pop("writes", {}),
        "refusals": REFUSALS | stated.pop("refusals", {}),
        "plc": PLC | stated.pop("plc", {}),
        "serve": {}, "bridge": {}, "published": 0, "logged": 0, "log_dropped": 0,
        **stated,
    }  # fmt: skip
    return msgspec.convert(whole, GatewayStatus)


def changed(status: GatewayStatus, **parts: Any) -> GatewayStatus:
    """Return `status` with some fields replaced; a mapping of names changes only these members: ``devices={"a": {...}}``."""
    data = msgspec.to_builtins(status)
    for name, part in parts.items():
        if name in ("devices", "buses"):
            data[name] = {**data[name], **{key: data[name][key] | fields for key, fields in part.items()}}
        else:
            data[name] = data[name] | part if isinstance(part, dict) else part
    return msgspec.convert(data, GatewayStatus)
