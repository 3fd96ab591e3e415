"""The counters of a Modbus client."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(slots=True)
class ClientCounters:
    """Counters of this connection since it was opened.

    Every request sent is counted in `requests` and, when it ends, in exactly one other counter: requests = broadcasts + replies +
    exceptions + timeouts + crc_errors + desyncs + verify_failures + abandoned, plus the request in progress. `replies` counts
    normal replies only, `broadcasts` all requests that are never answered, and `abandoned` the requests that were cancelled or
    lost with the connection. `late_bytes` counts bytes of late or duplicate replies, and `noise_bytes` those that are not part of
    any reply to this client.
    """

    requests: int = 0
    broadcasts: int = 0
    replies: int = 0
    exceptions: int = 0
    timeouts: int = 0
    crc_errors: int = 0
    desyncs: int = 0
    verify_failures: int = 0
    abandoned: int = 0
    late_bytes: int = 0
    noise_bytes: int = 0
    foreign_frames: int = 0
