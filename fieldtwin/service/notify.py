"""What a service says to systemd: READY, WATCHDOG, RELOADING, STOPPING and a line of status, as datagrams (sd_notify(3)).

No library is needed for that: text lines to the Unix datagram socket in NOTIFY_SOCKET. A datagram that cannot be delivered is
counted and forgotten: a service does not fail because nobody listens.
"""

from __future__ import annotations

import os
import socket
from collections.abc import MutableMapping
from contextlib import suppress

USEC_PER_S = 1_000_000


class Notifier:
    """`watchdog_s` is how often systemd wants to hear of us, 0 for never. Without a socket everything is for nothing."""

    def __init__(self, address: str = "", watchdog_s: float = 0.0) -> None:
        self.watchdog_s = watchdog_s
        self.lost = 0
        self._address = "\0" + address[1:] if address.startswith("@") else address
        self._socket: socket.socket | None = None
        if address:
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
            self._socket.setblocking(False)

    @classmethod
    def from_environment(cls, environment: MutableMapping[str, str] = os.environ) -> Notifier:
        """What systemd says in the environment, and taken out of it: processes that we start are not to notify in our name."""
        address = environment.pop("NOTIFY_SOCKET", "")
        interval = environment.pop("WATCHDOG_USEC", "")
        meant_for = environment.pop("WATCHDOG_PID", "")
        ours = not meant_for or meant_for == str(os.getpid())
        watchdog_s = int(interval) / USEC_PER_S if ours and interval.isascii() and interval.isdigit() else 0.0
        return cls(address if address[:1] in ("/", "@") else "", watchdog_s)

    @property
    def wanted(self) -> bool:
        """Whether somebody listens."""
        return self._socket is not None

    def ready(self, status: str) -> None:
        """Started; also after a reload."""
        self._send("READY=1", _status(status))

    def alive(self, status: str) -> None:
        """All is well: keep the watchdog quiet."""
        self._send("WATCHDOG=1", _status(status))

    def status(self, status: str) -> None:
        """A line for `systemctl status`."""
        self._send(_status(status))

    def reloading(self, now_ns: int) -> None:
        """A reload has begun, at `now_ns` of CLOCK_MONOTONIC, which Type=notify-reload asks for; `ready` ends it."""
        self._send("RELOADING=1", f"MONOTONIC_USEC={now_ns // 1000}")

    def stopping(self) -> None:
        """Ending in order."""
        self._send("STOPPING=1")

    def close(self) -> None:
        """Say nothing more."""
        if self._socket is not None:
            with suppress(OSError):
                self._socket.close()
            self._socket = None

    def _send(self, *lines: str) -> None:
        if self._socket is None:
            return
        try:
            self._socket.sendto("\n".join(lines).encode(), self._address)
        except OSError:
            self.lost += 1


def _status(text: str) -> str:
    """One line, whatever it says."""
    return "STATUS=" + " ".join(text.split())[:512]
